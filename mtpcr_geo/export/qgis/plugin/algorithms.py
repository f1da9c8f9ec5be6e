"""The algorithms: parameters as ``verbs.json`` declares them, and what each verb gives back."""

from __future__ import annotations

import json
import os

from processing.core.ProcessingConfig import ProcessingConfig
from qgis.core import (
    QgsProcessingAlgorithm,
    QgsProcessingContext,
    QgsProcessingException,
    QgsProcessingOutputFile,
    QgsProcessingOutputNumber,
    QgsProcessingOutputString,
    QgsProcessingParameterBoolean,
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterFile,
    QgsProcessingParameterFileDestination,
    QgsProcessingParameterFolderDestination,
    QgsProcessingParameterNumber,
    QgsProcessingParameterPoint,
    QgsProcessingParameterString,
)
from qgis.PyQt.QtGui import QIcon

from .command import SETTING, Answer, CommandError, arguments, find, run

_ICON = os.path.join(os.path.dirname(__file__), "icon.svg")
_LOAD = "LOAD"


class VerbAlgorithm(QgsProcessingAlgorithm):
    """A verb of the command as an algorithm.

    Class attributes:
        verb: the verb.
        title: what the toolbox shows.
        force_json: whether the verb is asked for JSON on standard output.

    """

    verb = ""
    title = ""
    force_json = True

    def __init__(self, declared):
        super().__init__()
        self.declared = declared

    def name(self):
        """Return the last part of the algorithm's id."""
        return self.verb

    def displayName(self):
        """Return what the toolbox shows."""
        return self.title

    def shortHelpString(self):
        """Return the verb's help."""
        return self.declared["help"]

    def icon(self):
        """Return the icon."""
        return QIcon(_ICON)

    def createInstance(self):
        """Return a new one of the same kind."""
        return type(self)(self.declared)

    def initAlgorithm(self, configuration=None):
        """Declare parameters and outputs."""
        for one in self.declared["parameters"]:
            parameter = _parameter(one)
            parameter.setHelp(one["help"])
            if one["advanced"]:
                parameter.setFlags(parameter.flags() | QgsProcessingParameterDefinition.FlagAdvanced)
            self.addParameter(parameter)
        self.declare_outputs()

    def declare_outputs(self):
        """Declare what is given back beside the files that parameters name."""

    def processAlgorithm(self, parameters, context, feedback):
        """Call the command, and give back what it came to."""
        values = {one["name"]: self._value(one, parameters, context) for one in self.declared["parameters"]}
        if values.get("near") is not None and not values.get("near_crs"):
            crs = self.parameterAsPointCrs(parameters, "NEAR", context)
            values["near_crs"] = crs.authid() or None
        extra = ["--json"] if self.force_json else []
        try:
            command = find(str(ProcessingConfig.getSetting(SETTING) or ""))
            words = [command, self.verb, *extra, *arguments(self.declared["parameters"], values)]
            feedback.pushCommandInfo(" ".join(words))
            answer = run(words, feedback.isCanceled)
            for line in answer.talk.splitlines():
                feedback.pushInfo(line)
            return self.results(answer, values, parameters, context, feedback)
        except CommandError as error:
            raise QgsProcessingException(str(error)) from error

    def results(self, answer: Answer, values, parameters, context, feedback):
        """Return what a call gave, by the names of the outputs."""
        raise NotImplementedError

    def _value(self, one, parameters, context):
        name = one["name"].upper()
        kind = one["kind"]
        if parameters.get(name) is None and not one["required"]:
            return one["default"] if kind == "switch" else None
        if kind == "switch":
            return self.parameterAsBool(parameters, name, context)
        if kind == "choice":
            return self.parameterAsString(parameters, name, context)
        if kind == "number":
            return self.parameterAsDouble(parameters, name, context)
        if kind == "integer":
            return self.parameterAsInt(parameters, name, context)
        if kind == "point":
            point = self.parameterAsPoint(parameters, name, context)
            return [repr(point.x()), repr(point.y())]
        if kind in ("out_file", "out_folder"):
            return self.parameterAsFileOutput(parameters, name, context)
        return self.parameterAsString(parameters, name, context)


class Register(VerbAlgorithm):
    """The verb register."""

    verb = "register"
    title = "Register a cloud to another"

    def declare_outputs(self):
        """Declare the verdict, and the files worth opening."""
        self.addParameter(QgsProcessingParameterBoolean(_LOAD, "Open the rasters in the map", True))
        self.addOutput(QgsProcessingOutputString("VERDICT", "Verdict"))
        self.addOutput(QgsProcessingOutputString("SENTENCE", "Verdict in a sentence"))
        for name, what in (
            ("PROJECT", "QGIS project"),
            ("REPORT", "Report"),
            ("REGISTERED", "Registered cloud"),
        ):
            self.addOutput(QgsProcessingOutputFile(name, what))

    def results(self, answer, values, parameters, context, feedback):
        """Say the verdict; a refused one is a warning, and leaves its evidence."""
        facts = answer.json()
        verdict = facts["verdict"]
        say = feedback.pushInfo if verdict == "accepted" else feedback.pushWarning
        say(facts["sentence"])
        for reason in facts["reasons"]:
            say(f"  {reason}")
        files = {os.path.basename(path): path for path in facts["outputs"]}
        if self.parameterAsBool(parameters, _LOAD, context):
            for name, title in (("registered.tif", "Source, registered"), ("target.tif", "Target")):
                if name in files:
                    details = QgsProcessingContext.LayerDetails(title, context.project(), title)
                    context.addLayerToLoadOnCompletion(files[name], details)
        return {
            "OUT": values["out"],
            "VERDICT": verdict,
            "SENTENCE": facts["sentence"],
            "PROJECT": files.get("project.qgz"),
            "REPORT": files.get("report.html"),
            "REGISTERED": files.get("registered.laz"),
        }


class Apply(VerbAlgorithm):
    """The verb apply."""

    verb = "apply"
    title = "Move a cloud by the transform of a registration"
    force_json = False

    def results(self, answer, values, parameters, context, feedback):
        """Return the file written."""
        if answer.code != 0:
            raise CommandError(answer.talk.strip() or f"exit code {answer.code}")
        for line in answer.output.splitlines():
            feedback.pushInfo(line)
        return {"OUT": values["out"]}


class Check(VerbAlgorithm):
    """The verb check."""

    verb = "check"
    title = "Check one or two clouds before registering"

    def declare_outputs(self):
        """Declare what was found."""
        self.addParameter(
            QgsProcessingParameterFileDestination(
                "FINDINGS", "What was found, as JSON", "JSON (*.json)", optional=True, createByDefault=False
            )
        )
        self.addOutput(QgsProcessingOutputString("GOES_ON", "Whether register would go on: yes or no"))
        self.addOutput(QgsProcessingOutputNumber("EXIT_CODE", "Exit code with which register would end"))
        self.addOutput(QgsProcessingOutputNumber("ERRORS", "Errors found"))
        self.addOutput(QgsProcessingOutputNumber("WARNINGS", "Warnings found"))

    def results(self, answer, values, parameters, context, feedback):
        """Print the findings; an error in a cloud is a finding, and no failure of the check."""
        facts = answer.json()
        say = {"error": feedback.reportError, "warning": feedback.pushWarning}
        for one in facts["findings"]:
            fix = f"; {one['fix']}" if one["fix"] else ""
            say.get(one["severity"], feedback.pushInfo)(f"{one['role']}: {one['what']}{fix}")
        number = {kind: sum(one["severity"] == kind for one in facts["findings"]) for kind in say}
        results = {
            "GOES_ON": "yes" if facts["goes_on"] else "no",
            "EXIT_CODE": facts["exit_code"],
            "ERRORS": number["error"],
            "WARNINGS": number["warning"],
        }
        path = self.parameterAsFileOutput(parameters, "FINDINGS", context)
        if path:
            with open(path, "w", encoding="utf-8") as file:
                json.dump(facts, file, indent=2)
            results["FINDINGS"] = path
        return results


ALGORITHMS = {kind.verb: kind for kind in (Register, Apply, Check)}


def _parameter(one):
    """Return QGIS's parameter for one in ``verbs.json``."""
    name, label, kind, default = one["name"].upper(), one["label"], one["kind"], one["default"]
    optional = not one["required"]
    if kind == "switch":
        return QgsProcessingParameterBoolean(name, label, defaultValue=default, optional=True)
    if kind == "choice":
        return QgsProcessingParameterEnum(
            name,
            label,
            options=one["choices"],
            defaultValue=default,
            optional=optional,
            usesStaticStrings=True,
        )
    if kind in ("number", "integer"):
        numbers = QgsProcessingParameterNumber
        of = numbers.Double if kind == "number" else numbers.Integer
        return numbers(name, label, type=of, defaultValue=default, optional=optional)
    if kind == "point":
        return QgsProcessingParameterPoint(name, label, optional=optional)
    if kind == "file":
        return QgsProcessingParameterFile(name, label, optional=optional)
    if kind == "folder":
        behavior = QgsProcessingParameterFile.Folder
        return QgsProcessingParameterFile(name, label, behavior=behavior, optional=optional)
    if kind == "out_folder":
        return QgsProcessingParameterFolderDestination(name, label)
    if kind == "out_file":
        return QgsProcessingParameterFileDestination(name, label, "LAZ (*.laz);;LAS (*.las);;All files (*)")
    return QgsProcessingParameterString(name, label, defaultValue=default, optional=optional)
