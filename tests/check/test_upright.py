from __future__ import annotations

import numpy as np
import pytest
from helpers_scene import houses

from mtpcr_geo.check.upright import upright_findings
from mtpcr_geo.core import transforms

X = np.array([1.0, 0.0, 0.0])
Y = np.array([0.0, 1.0, 0.0])


@pytest.mark.parametrize(
    ("R", "code", "words"),
    [
        (transforms.axis_angle_matrix(X, -np.pi / 2), "lies-on-its-side", "is y up"),
        (transforms.axis_angle_matrix(X, np.pi / 2), "lies-on-its-side", "is -y up"),
        (transforms.axis_angle_matrix(Y, np.pi / 2), "lies-on-its-side", "is x up"),
        (np.diag([1.0, -1.0, -1.0]), "upside-down", "upside down"),
        (transforms.axis_angle_matrix(X, np.radians(25.0)), "tilted", "25 degrees"),
    ],
)
def test_a_cloud_that_does_not_stand_upright_is_named(R: np.ndarray, code: str, words: str) -> None:
    xyz = houses(np.random.default_rng(1), 40_000)
    (finding,) = upright_findings(xyz @ R.T, "source")
    assert finding.code == code
    assert words in finding.what
    if "turn it beforehand" in finding.fix:
        # the turn that the message names makes it upright again
        wanted = finding.fix.rpartition(" to ")[2].strip("()").split(", ")
        turned = [
            np.sign(-1 if one[0] == "-" else 1) * (xyz @ R.T)[:, "xyz".index(one[-1])] for one in wanted
        ]
        assert not list(upright_findings(np.column_stack(turned), "source"))


def test_an_upright_cloud_has_no_finding() -> None:
    assert not list(upright_findings(houses(np.random.default_rng(2), 40_000), "source"))
