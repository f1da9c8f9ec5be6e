"""The provider: one algorithm a verb, and where the command is."""

from __future__ import annotations

import json
import os

from processing.core.ProcessingConfig import ProcessingConfig, Setting
from qgis.core import QgsProcessingProvider
from qgis.PyQt.QtGui import QIcon

from .algorithms import ALGORITHMS
from .command import SETTING

_FOLDER = os.path.dirname(__file__)
ICON = os.path.join(_FOLDER, "icon.svg")


class Provider(QgsProcessingProvider):
    """Algorithms that call the installed command."""

    def load(self):
        """Read the setting of the command's place, and the algorithms."""
        ProcessingConfig.addSetting(
            Setting(
                self.name(),
                SETTING,
                "The command mtpcr-geo (looked for if empty)",
                "",
                valuetype=Setting.FILE,
            )
        )
        ProcessingConfig.readSettings()
        self.refreshAlgorithms()
        return True

    def unload(self):
        """Forget the setting."""
        ProcessingConfig.removeSetting(SETTING)

    def loadAlgorithms(self):
        """Make an algorithm of each verb."""
        with open(os.path.join(_FOLDER, "verbs.json"), encoding="utf-8") as file:
            verbs = json.load(file)
        for name, kind in ALGORITHMS.items():
            self.addAlgorithm(kind(verbs[name]))

    def id(self):
        """Return the first part of the algorithms' ids."""
        return "mtpcr_geo"

    def name(self):
        """Return what the toolbox shows."""
        return "Lidar registration (mtpcr-geo)"

    def icon(self):
        """Return the icon."""
        return QIcon(ICON)
