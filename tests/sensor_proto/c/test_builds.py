"""Headers and ports compile without warnings, and are no larger than docs/firmware.md says."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT

C = ROOT / "sensor_proto" / "c"
WARNINGS = (
    *("-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wsign-conversion", "-Wshadow"),
    *("-Wundef", "-Werror"),
)
STRICT_C = ("-Wstrict-prototypes", "-Wmissing-prototypes")
HEADERS = ("tactile_proto.h", "board.h", "mlx90393.h")
TARGETS = {
    "gcc": ["gcc", "-std=c99", *STRICT_C],
    "g++": ["g++", "-std=c++17"],
    "clang": ["clang", "-std=c99", *STRICT_C],
    "Cortex-M0+": ["arm-none-eabi-gcc", "-std=c99", "-mcpu=cortex-m0plus", "-mthumb", *STRICT_C],
    "Cortex-M3": ["arm-none-eabi-gcc", "-std=c99", "-mcpu=cortex-m3", "-mthumb", *STRICT_C],
    "ATmega328P": ["avr-gcc", "-std=c99", "-mmcu=atmega328p", *STRICT_C],
}
MEDIA = {"serial": [], "can": ["-DBOARD_CAN=1", "-DTP_CAN_BYTES=8"], "canfd": ["-DBOARD_CAN=1"]}


@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("target", TARGETS)
def test_headers_compile_without_warnings(
    target: str, medium: str, need: Callable[[str], str], tmp_path: Path
) -> None:
    compiler, *flags = TARGETS[target]
    source = tmp_path / f"all.{'cpp' if target == 'g++' else 'c'}"
    source.write_text(
        "".join(f'#include "{h}"\n' for h in HEADERS) + "int main(void) { return 0; }\n"
    )
    words = [need(compiler), *flags, *MEDIA[medium], *WARNINGS, "-Os", f"-I{C}", "-c", str(source)]
    done = subprocess.run(
        [*words, "-o", str(tmp_path / "all.o")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("header", HEADERS)
def test_each_header_compiles_alone(
    header: str, need: Callable[[str], str], tmp_path: Path
) -> None:
    source = tmp_path / "one.c"
    source.write_text(f'#include "{header}"\n#include "{header}"\nint one;\n')
    words = [need("gcc"), "-std=c99", *WARNINGS, f"-I{C}", "-fsyntax-only", str(source)]
    subprocess.run(words, check=True)


def test_smoke_inputs_pass_under_sanitizers(build: Callable[..., Path], need: Any) -> None:
    """The fuzzer's entry points on inputs of a fixed seed, for machines without libFuzzer."""
    flags = ["-std=c99", "-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    program = build("smoke", "test/smoke.c", *flags)
    subprocess.run([program], check=True, timeout=120)


SIZES = {
    "Cortex-M0+": (["arm-none-eabi-gcc", "-mcpu=cortex-m0plus", "-mthumb"], "arm-none-eabi-size"),
    "Cortex-M3": (["arm-none-eabi-gcc", "-mcpu=cortex-m3", "-mthumb"], "arm-none-eabi-size"),
    "ATmega328P": (["avr-gcc", "-mmcu=atmega328p"], "avr-size"),
}
SMALL = "-std=c99 -Os -ffunction-sections -fdata-sections -Wl,--gc-sections".split()  # noqa: SIM905


@pytest.mark.parametrize("target", SIZES)
def test_board_size_is_within_documented_limits(
    target: str, need: Callable[[str], str], build: Callable[..., Path], notes: dict[str, Any]
) -> None:
    (compiler, *flags), sizer = SIZES[target]
    need(compiler)
    if compiler.startswith("arm"):
        flags += ["-nostartfiles", "-Wl,-e,main"]
    rows = {}
    for what, source, more in (
        ("codec", "test/size_codec.c", []),
        ("board, serial", "test/size_board.c", []),
        ("board, CAN 2.0B", "test/size_board.c", ["-DSIZE_CAN"]),
        ("board, serial, with the MLX90393 driver", "test/size_mlx.c", []),
    ):
        program = build("size.elf", source, *flags, *SMALL, *more, compiler=compiler)
        sizer_path = shutil.which(sizer)
        assert sizer_path
        told = subprocess.run([sizer_path, program], capture_output=True, text=True, check=True)
        text, data, bss = map(int, told.stdout.splitlines()[1].split()[:3])
        rows[what] = {"code_bytes": text + data, "ram_bytes": data + bss}
    notes.setdefault("sizes", {})[target] = rows
    if target == "Cortex-M0+":
        assert rows["board, serial"]["code_bytes"] <= 4096
        assert rows["board, serial"]["ram_bytes"] <= 512


def test_libfuzzer_finds_nothing_in_a_million_inputs(
    build: Callable[..., Path], long_run: None, notes: dict[str, Any], tmp_path: Path
) -> None:
    flags = ["-std=c99", "-g", "-O1", "-fsanitize=fuzzer,address,undefined"]
    program = build("fuzz", "test/fuzz.c", *flags, "-fno-sanitize-recover=all", compiler="clang")
    (tmp_path / "corpus").mkdir()
    words = [str(program), "-runs=1000000", "-max_len=2048", "-seed=1", "corpus"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    found = re.findall(r"#(\d+)\s+DONE\s+cov: (\d+)", done.stderr)
    notes["fuzz"] = {"runs": int(found[0][0]), "coverage_edges": int(found[0][1]), "failures": 0}


def test_package_manifests_name_existing_files() -> None:
    version = re.search(r"^version=(.+)$", (C / "library.properties").read_text(), re.M)
    assert version
    told = json.loads((C / "library.json").read_text())
    assert told["version"] == version[1]
    for header in told["headers"]:
        assert (C / header).exists()
    for example in told["examples"]:
        assert (C / example["base"] / example["files"][0]).exists()
    assert (C / "zephyr" / "module.yml").exists()
    assert (C / "zephyr" / "CMakeLists.txt").exists()


@pytest.mark.parametrize("sketch", sorted(p.name for p in (C / "examples").glob("*")))
def test_sketches_compile_against_stand_in_headers(
    sketch: str, need: Callable[[str], str], tmp_path: Path
) -> None:
    source = tmp_path / "sketch.cpp"
    text = (C / "examples" / sketch / f"{sketch}.ino").read_text()
    source.write_text("#include <Arduino.h>\n" + text)
    words = [need("g++"), "-std=c++17", "-Wall", "-Wextra", "-Werror", "-fsyntax-only"]
    subprocess.run([*words, f"-I{C}", f"-I{C / 'test' / 'stand_in'}", str(source)], check=True)
