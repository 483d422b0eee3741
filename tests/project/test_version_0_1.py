"""Files of version 0.1 are read, or refused with a sentence that names the remedy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from reachd.arguments import make_parser as reach_parser
from reachd.settings import make_settings as reach_settings
from sim_device.skin.indenter import load_script
from tactile_core import calibration
from tactile_core.config import ConfigError, load_toml
from tactiled.arguments import make_parser as skin_parser
from tactiled.settings import ConfigFile
from tactiled.settings import make_settings as skin_settings
from tests.support.paths import DATA

OLD = DATA / "version_0_1"

HASHES = {
    "anyskin.cal.toml": "3fdb0c82db68e3ea66911a8d80c851d2bd9232958c1c19d7d65ab0e4ef43e8fd",
    "fitted.cal.toml": "3015a598b8a267bdb36c00a5fad31642c8fdf48dee2f60569945966943856eae",
}
"""Hashes of the values that version 0.1 wrote."""


@pytest.mark.parametrize("name", HASHES)
def test_calibration_is_read_and_written_unchanged(name: str) -> None:
    text = (OLD / name).read_text(encoding="utf-8")
    read = calibration.loads(text, name)
    assert read.hash == HASHES[name]
    assert calibration.saves(read) == text


def test_press_script_is_read() -> None:
    indenter = load_script(OLD / "press.toml")
    assert indenter.duration == 12.0
    assert len(indenter.presses) == 3


def test_tactiled_configuration_is_read() -> None:
    options = skin_parser().parse_args(["--config", str(OLD / "tactiled.toml")])
    settings = skin_settings(options)
    assert [port.name for port in settings.ports] == ["left", "hand"]
    assert settings.ports[1].nodes == {3: "hand"}
    assert settings.pipeline.compensation_rate_hz == 10.0
    assert settings.pipeline.rest_tracking_s == 60.0
    assert settings.recorder.max_files == 10
    assert settings.bus.listen == ("tcp/127.0.0.1:7447",)


def test_reachd_configuration_is_read() -> None:
    options = reach_parser().parse_args(["--config", str(OLD / "reachd.toml")])
    settings = reach_settings(options)
    assert settings.goal is not None
    assert (settings.goal.radius, settings.goal.time_limit) == (0.002, 15.0)
    assert settings.parameters.safety.force == 18.0
    assert settings.parameters.safety.tip_region.corners[0] == (-0.3, -0.3)
    assert settings.parameters.safety.disabled == {"slow_down"}


def test_former_tls_names_are_refused_with_remedy(tmp_path: Path) -> None:
    path = tmp_path / "tactiled.toml"
    shutil.copy(OLD / "tactiled.toml", path)
    with path.open("a", encoding="utf-8") as file:
        file.write(
            '[bus.tls]\nroot_ca = "a"\ncertificate = "b"\nprivate_key = "c"\nallowed = ["anna"]\n'
        )
    with pytest.raises(ConfigError, match=r"bus\.tls\.allowed.*\[bus\.tls\.roles\]"):
        load_toml(path, ConfigFile)
