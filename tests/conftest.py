from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_paths import REPOSITORY
from hypothesis import HealthCheck, settings
from numpy.typing import NDArray
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.write import write_cloud

# No deadlines, and no health check that goes by the clock: how long an example takes depends on what else the
# machine does. The same examples in every run, so that a failure can be repeated; new ones are looked for
# with `--hypothesis-profile=explore`. A failing example is printed with the line that repeats it.
settings.register_profile(
    "repeatable",
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.register_profile("explore", settings.get_profile("repeatable"), derandomize=False)
settings.load_profile("repeatable")

BEGUN = time.monotonic()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--within", type=float, metavar="MINUTES", help="skip, and count, tests that have not begun by then"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run the tests of real data first where the time is limited: they are the last to be left out."""
    if config.getoption("within") is not None:
        real = {"shared_data", "shared_cases"}
        items.sort(key=lambda item: real.isdisjoint(getattr(item, "fixturenames", ())))


def pytest_runtest_setup(item: pytest.Item) -> None:
    within = item.config.getoption("within")
    if within is not None and time.monotonic() - BEGUN > 60 * within:
        pytest.skip(f"not begun within {within:g} minutes")


def _shared(name: str) -> Path:
    folder = REPOSITORY.parent / "shared" / name
    if not folder.is_dir():
        pytest.skip(f"../shared/{name} is not there")
    return folder


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real lidar pairs, which stays outside the project."""
    return _shared("data")


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """The folder of small inputs that stand for kinds, which stays outside the project."""
    return _shared("cases")


@pytest.fixture(scope="session")
def shared_models() -> Path:
    """The folder of model files, which stays outside the project."""
    return _shared("models")


@pytest.fixture(scope="session")
def pdal():
    """The pdal package; tests that need it skip where it is not installed."""
    return pytest.importorskip("pdal", reason="PDAL is not installed")


@pytest.fixture
def hears() -> Iterator[tuple[str, list[Any]]]:
    """The address of a server on this machine, and the list of those who have come."""
    from helpers_security import listening

    with listening() as server:
        yield server


@pytest.fixture(scope="session")
def town_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two small LAZ files of one made-up town: the source, turned and shifted, and the target."""
    from helpers_scene import ORIGIN, TOWN_TURNED, town

    rng = np.random.default_rng(7)
    folder = tmp_path_factory.mktemp("town")
    target = town(rng, 60_000) + ORIGIN
    source = town(rng, 40_000)
    source = transforms.apply(TOWN_TURNED, source[source[:, 0] > -30.0]) + ORIGIN
    files = []
    for name, xyz in (("source", source), ("target", target)):
        extra: dict[str, NDArray[np.generic]] = {
            "Intensity": rng.integers(0, 2000, len(xyz)).astype(np.uint16),
            "Classification": np.where(xyz[:, 2] > ORIGIN[2] + 5.0, 6, 2).astype(np.uint8),
            "GpsTime": np.arange(len(xyz)) * 1e-3,
        }
        cloud = ArrayCloud(xyz, CRS.from_epsg(25833), name, extra)
        write_cloud(folder / f"{name}.laz", cloud, None, cloud.crs)
        files.append(folder / f"{name}.laz")
    return files[0], files[1]


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the LAS files that are decoded from now on, once each time."""
    names: list[str] = []
    decode = LasCloud.record_chunks

    def counting(cloud, *args, **more):
        names.append(cloud.name)
        return decode(cloud, *args, **more)

    monkeypatch.setattr(LasCloud, "record_chunks", counting)
    return names
