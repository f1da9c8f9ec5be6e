from __future__ import annotations

import pytest

from mtpcr_geo.io.las import LasCloud


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
