"""`tactile bus`: keys for a lab, and the secret of this machine's rigs."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from tactile_core.bus import runtime
from tactile_core.bus.keys import load_keys
from tactile_tools.cli import main

pytest.importorskip("cryptography", reason="making keys needs cryptography")
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID


def certificate(folder: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())


def test_one_command_creates_keys_for_a_lab(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    lab = tmp_path / "lab"
    assert main(["bus", "keys", str(lab), "--host", "robot.lan", "--host", "10.0.0.7"]) == 0
    assert "off the robots" in capsys.readouterr().out
    roles = {"tactiled", "reachd", "arm", "operator", "viewer"}
    assert {p.name for p in lab.iterdir() if p.is_dir()} == roles
    for name in roles:
        tls = load_keys(lab / name)
        assert tls.role() == name
        assert {p.name for p in (lab / name).iterdir()} == {
            "ca.pem", "cert.pem", "key.pem", "roles.toml",
        }  # fmt: skip
        assert stat.S_IMODE((lab / name / "key.pem").stat().st_mode) == 0o600
        made = certificate(lab / name)
        uses = made.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        listens = name in ("tactiled", "reachd", "arm")
        assert (ExtendedKeyUsageOID.SERVER_AUTH in uses) == listens
        if listens:
            hosts = made.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            assert "robot.lan" in hosts.get_values_for_type(x509.DNSName)
            assert "10.0.0.7" in map(str, hosts.get_values_for_type(x509.IPAddress))
    assert stat.S_IMODE((lab / "ca.key").stat().st_mode) == 0o600


def test_parties_are_added_renewed_and_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    lab = tmp_path / "lab"
    assert main(["bus", "keys", str(lab)]) == 0
    authority = (lab / "ca.pem").read_bytes()
    assert main(["bus", "keys", str(lab), "--party", "anna=operator", "--days", "30"]) == 0
    assert (lab / "ca.pem").read_bytes() == authority
    # Every party's list has her name, so her peers admit her.
    for party in ("arm", "operator", "anna"):
        assert load_keys(lab / party).roles.operator == ("operator", "anna")
    anna = certificate(lab / "anna")
    assert 29 < (anna.not_valid_after_utc - anna.not_valid_before_utc).days <= 30
    words = ["bus", "keys", str(lab), "--party", "anna=operator"]
    assert main(words) == 2
    assert "--again" in capsys.readouterr().err
    assert main([*words, "--again"]) == 0
    assert certificate(lab / "anna").serial_number != anna.serial_number
    assert main(["bus", "keys", str(lab), "--party", "anna=viewer", "--again"]) == 2
    assert "has the role operator already" in capsys.readouterr().err
    assert main(["bus", "keys", str(lab), "--remove", "anna"]) == 0
    assert load_keys(lab / "arm").roles.operator == ("operator",)
    assert main(["bus", "keys", str(lab), "--remove", "anna"]) == 2
    assert "named there: tactiled, reachd, arm, operator, viewer" in capsys.readouterr().err


@pytest.mark.parametrize("party", ["anna", "anna=king", "a/b=operator", "..=operator", "=viewer"])
def test_impossible_parties_are_refused(
    tmp_path: Path, party: str, capsys: pytest.CaptureFixture
) -> None:
    try:
        code = main(["bus", "keys", str(tmp_path / "lab"), "--party", party])
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    assert not (tmp_path / "lab").exists()
    assert capsys.readouterr().err


def test_incomplete_authority_is_not_replaced_silently(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    lab = tmp_path / "lab"
    assert main(["bus", "keys", str(lab)]) == 0
    (lab / "ca.key").unlink()
    assert main(["bus", "keys", str(lab), "--party", "anna=operator"]) == 2
    assert "put its ca.pem and ca.key back" in capsys.readouterr().err
    assert not (lab / "anna").exists()


def test_secret_is_shown_only_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setenv(runtime.SYSTEMD_VARIABLE, str(tmp_path))
    assert main(["bus", "secret"]) == 0
    _, secret = runtime.token_file(runtime.home())
    assert secret not in capsys.readouterr().out
    assert main(["bus", "secret", "--show"]) == 0
    assert secret in capsys.readouterr().out
