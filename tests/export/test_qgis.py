"""What QGIS itself makes of the files, where it is installed: layers, pictures, the plugin's algorithms."""

from __future__ import annotations

import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from helpers_qgis import ask, process
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.cli.demo import run_demo
from mtpcr_geo.registration import register

pytestmark = pytest.mark.slow

READ = """
project = QgsProject.instance()
answer["read"] = project.read(sys.argv[1])
answer["crs"] = project.crs().authid()
view = project.viewSettings().defaultViewExtent()
whole = project.viewSettings().fullExtent()
answer["view"] = [view.xMinimum(), view.yMinimum(), view.xMaximum(), view.yMaximum()]
answer["whole"] = [whole.xMinimum(), whole.yMinimum(), whole.xMaximum(), whole.yMaximum()]
answer["layers"] = {}
for layer in project.mapLayers().values():
    box = layer.extent()
    vector = layer.type() == QgsMapLayer.VectorLayer
    answer["layers"][layer.id()] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "georeferenced": layer.crs().isValid(),
        "extent": [box.xMinimum(), box.yMinimum(), box.xMaximum(), box.yMaximum()],
        "renderer": layer.renderer().type(),
        "rows": layer.featureCount() if vector else None,
        "aliases": [layer.attributeAlias(i) for i in range(1, layer.fields().count())] if vector else [],
    }
"""
DRAW = """
themes = project.mapThemeCollection()
answer["themes"] = {}
for name in themes.mapThemes():
    settings = QgsMapSettings()
    settings.setLayers(themes.mapThemeVisibleLayers(name))
    settings.setDestinationCrs(project.crs())
    settings.setExtent(view)
    settings.setOutputSize(QSize(600, 450))
    settings.setBackgroundColor(QColor("white"))
    context = QgsExpressionContext()
    context.appendScope(QgsExpressionContextUtils.mapSettingsScope(settings))
    settings.setExpressionContext(context)
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    path = os.path.join(sys.argv[2], name + ".png")
    job.renderedImage().save(path)
    answer["themes"][name] = [error.message for error in job.errors()]
answer["pages"] = {}
for page in project.layoutManager().printLayouts():
    options = QgsLayoutExporter.ImageExportSettings()
    options.dpi = 60
    path = os.path.join(sys.argv[2], "page.png")
    answer["pages"][page.name()] = QgsLayoutExporter(page).exportToImage(path, options)
"""
ALONE = """
raster = QgsRasterLayer(sys.argv[1], "raster")
answer["renderer"] = raster.renderer().type()
answer["band"] = raster.renderer().band()
answer["low"], answer["high"] = raster.renderer().classificationMin(), raster.renderer().classificationMax()
table = QgsVectorLayer(sys.argv[2] + "|layername=tie_points", "ties")
answer["rules"] = [rule.label() for rule in table.renderer().rootRule().children()]
answer["alias"] = table.attributeAlias(table.fields().indexOf("plan_m"))
answer["drawn"] = []
for scale in (200.0, 5000.0, 1000000.0):
    settings = QgsMapSettings()
    context = QgsRenderContext.fromMapSettings(settings)
    scope = QgsExpressionContextScope()
    scope.setVariable("map_scale", scale)
    context.expressionContext().appendScope(scope)
    renderer = table.renderer().clone()
    renderer.startRender(context, table.fields())
    drawn = 0
    for feature in table.getFeatures():
        context.expressionContext().setFeature(feature)
        drawn += renderer.willRenderFeature(feature, context)
    renderer.stopRender(context)
    answer["drawn"].append(drawn)
"""


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("demo")
    found = run_demo(folder, recording=False)
    assert found.registration.verdict.name == "accepted"
    return folder / "result"


def colours(path: Path) -> np.ndarray:
    """(n, 3) colours of a picture, red first, that are not white."""
    seen = cv2.imread(str(path))
    assert seen is not None
    picture = seen[..., ::-1].reshape(-1, 3)
    return picture[(picture < 250).any(axis=1)]


def look(out: Path, pictures: Path, home: Path) -> dict[str, Any]:
    pictures.mkdir()
    return ask(READ + DRAW, home, str(out / "project.qgz"), str(pictures))


def check(out: Path, found: dict[str, Any], pictures: Path) -> None:
    """Every layer is valid and has what its file has; every theme draws something of its own."""
    assert found["read"]
    layers = found["layers"]
    assert layers
    assert all(layer["valid"] for layer in layers.values()), layers
    rows = json.loads((out / "run.json").read_text(encoding="utf-8"))["metrics"]["tie_points"]
    assert layers["evidence_tie_points"]["rows"] == layers["evidence_links"]["rows"] == rows
    assert layers["evidence_footprints"]["rows"] == 2
    for key, layer in layers.items():
        if key.endswith("_colours"):
            name = "difference" if key.startswith("difference") else key.split("_")[1]
            if key == "after_source_colours":
                name = "registered"
            if key == "after_target_colours" and (out / "bev" / "target_upright.tif").exists():
                name = "target_upright"
            with rasterio.open(out / "bev" / f"{name}.tif") as file:
                np.testing.assert_allclose(layer["extent"], list(file.bounds), rtol=0, atol=1e-3)
            assert layer["renderer"] == "singlebandpseudocolor"
        if layer["rows"] is not None:
            assert all(layer["aliases"]), key
            assert layer["renderer"] == "RuleRenderer"
    with rasterio.open(out / "bev" / "difference.tif") as file:
        box = file.bounds
    view, whole = found["view"], found["whole"]
    assert view[0] < box.left < box.right < view[2]
    assert view[1] < box.bottom < box.top < view[3]
    assert whole[0] <= view[0] < view[2] <= whole[2]
    assert found["themes"] == {"Before": [], "After": [], "Evidence": []}
    for name in found["themes"]:
        drawn = colours(pictures / f"{name}.png")
        assert len(drawn) > 0.005 * 600 * 450, name
        assert len(np.unique(drawn // 16, axis=0)) > 20, name
    relief = colours(pictures / "After.png").mean(axis=0)
    # never purple: more green than blue
    assert relief[1] > relief[2]
    assert found["pages"] == {"Registration, A4": 0}
    assert len(colours(pictures / "page.png")) > 20_000


def test_the_project_of_the_demo(demo, tmp_path):
    found = look(demo, tmp_path / "pictures", tmp_path / "home")
    check(demo, found, tmp_path / "pictures")
    assert found["crs"] == "EPSG:25832"
    local = {key for key, layer in found["layers"].items() if not layer["georeferenced"]}
    assert local == {"before_source_colours", "before_source_shading"}


def test_the_folder_can_be_moved(demo, tmp_path):
    shutil.copytree(demo, tmp_path / "elsewhere")
    found = ask(READ, tmp_path / "home", str(tmp_path / "elsewhere" / "project.qgz"))
    assert found["read"]
    assert all(layer["valid"] for layer in found["layers"].values())


def test_files_opened_alone(demo, tmp_path):
    found = ask(ALONE, tmp_path / "home", str(demo / "bev" / "target.tif"), str(demo / "ties.gpkg"))
    assert (found["renderer"], found["band"]) == ("singlebandpseudocolor", 1)
    with rasterio.open(demo / "bev" / "target.tif") as file:
        heights = file.read(1)
    assert np.nanmin(heights) <= found["low"] < found["high"] <= np.nanmax(heights)
    assert len(found["rules"]) == 4
    assert found["alias"] == "Distance in plan (m)"
    every, some, few = found["drawn"]
    rows = json.loads((demo / "run.json").read_text(encoding="utf-8"))["metrics"]["tie_points"]
    assert every == rows
    assert every > some > few


@pytest.mark.parametrize("name", ["delft_urban_ahn3", "forest_plot_mls_uas", "robot_scans"])
def test_projects_of_real_pairs(name, shared_data, tmp_path):
    every: dict[str, dict[str, Any]] = {
        "delft_urban_ahn3": {"source_crs": "EPSG:7415", "target_crs": "EPSG:7415"},
        "forest_plot_mls_uas": {"source_crs": "local"},
        "robot_scans": {"local": True},
    }
    options = every[name]
    pair = shared_data / name
    out = tmp_path / "out"
    register(pair / "source.laz", pair / "target.laz", out, recording=False, **options)
    found = look(out, tmp_path / "pictures", tmp_path / "home")
    check(out, found, tmp_path / "pictures")


def test_the_algorithms_of_the_plugin(demo, tmp_path):
    done = CliRunner().invoke(app, ["qgis-plugin", "-o", str(tmp_path / "p.zip")])
    assert done.exit_code == 0
    with zipfile.ZipFile(tmp_path / "p.zip") as archive:
        archive.extractall(tmp_path / "plugins")
    home, plugins = tmp_path / "home", tmp_path / "plugins"
    clouds = [f"SOURCE={demo.parent / 'ground.laz'}", f"TARGET={demo.parent / 'aerial.laz'}"]
    enabled = process(["plugins", "enable", "mtpcr_geo_qgis"], home, plugins)
    assert enabled.returncode == 0, enabled.stderr

    def run(algorithm: str, *values: str) -> dict[str, Any]:
        ran = process(["--json", "run", f"mtpcr_geo:{algorithm}", "--", *values], home, plugins)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        return dict(json.loads(ran.stdout[ran.stdout.index("{") :])["results"])

    findings = tmp_path / "findings.json"
    asked = run("check", *clouds, "SOURCE_CRS=local", f"FINDINGS={findings}")
    assert (asked["GOES_ON"], asked["EXIT_CODE"], asked["ERRORS"]) == ("yes", 0, 0)
    assert json.loads(findings.read_text(encoding="utf-8"))["goes_on"]
    # without a CRS it would not go on, which is what the check finds
    assert run("check", *clouds)["EXIT_CODE"] == 6

    out = tmp_path / "out"
    made = run("register", *clouds, "SOURCE_CRS=local", f"OUT={out}", "RECORDING=false")
    assert made["VERDICT"] == "accepted"
    named = {"PROJECT": "project.qgz", "REPORT": "report.html", "REGISTERED": "registered.laz"}
    for key, name in named.items():
        assert Path(made[key]) == out / name
        assert Path(made[key]).is_file()
    assert not (out / "audit.rrd").exists()

    moved = tmp_path / "moved.laz"
    run("apply", f"TRANSFORM={out / 'transform.json'}", clouds[0].replace("SOURCE", "CLOUD"), f"OUT={moved}")
    import laspy

    with laspy.open(moved) as one, laspy.open(out / "registered.laz") as other:
        np.testing.assert_allclose(one.read().xyz, other.read().xyz, atol=2e-3)

    wrong = process(
        ["run", "mtpcr_geo:apply", "--", "TRANSFORM=no.json", "CLOUD=no.laz", f"OUT={tmp_path / 'x.laz'}"],
        home,
        plugins,
    )
    assert wrong.returncode != 0
    assert "no.json" in wrong.stdout + wrong.stderr
