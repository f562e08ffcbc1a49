"""Build wheels of prebuilt kernels, for machines without a compiler and for fast first solves.

    python tools/build_kernels.py [ROBOT...] [--target NAME...] [--out DIR] [--jobs N] [--all]

writes `casadi_ik_kernels-VERSION-py3-none-PLATFORM.whl` for every target (all five unless named):
the C of the robots (the twelve of `ROBOTS` unless named) at both vector widths, cross-compiled by
zig (`pip install 'casadi-ik[compiler]'`). The package uses these libraries if the wheel is
installed and was built from the same sources. A machine without AVX-512 cannot generate the C of
the wider vectors, which needs to run it; the tool then reports and omits it.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import os
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import casadi_ik as ik
from casadi_ik.compile import libraries
from casadi_ik.compile.compiler import FLAGS, ZIG, Compiler
from casadi_ik.compile.function_kernel import machine_lanes
from casadi_ik.compile.graphs import package_sources
from casadi_ik.export.project import kernel_uses

ROBOTS = {
    "kuka_lwr_barrett": "the package's own examples; Qiu & Kermani 2021",
    "ar10": "Chandra et al. 2019, the hand alone",
    "baxter_ar10": "Chandra et al. 2019, with the arm",
    "panda+allegro_right": "the most common research arm and the usual hand of grasp data sets",
    "panda+leap": "the usual low-cost hand",
    "fr3+leap": "the arm that follows the Panda",
    "xarm6+leap": "the usual low-cost arm",
    "xarm7+ability": "a prosthetic hand on a low-cost arm",
    "iiwa14+allegro_right": "the usual arm with torque sensors",
    "ur5e+shadow": "an industrial arm and the hand with most motors",
    "ur10e+schunk_svh": "an industrial arm and hand",
    "kinova_gen3+robotiq_3f": "a mobile manipulator's arm and an industrial hand",
}
"""Robots of the default wheel, and the reasons for them."""

TARGETS = {
    "linux_x86_64": ("x86_64-linux-gnu.2.17", "manylinux2014_x86_64"),
    "linux_aarch64": ("aarch64-linux-gnu.2.17", "manylinux2014_aarch64"),
    "macos_x86_64": ("x86_64-macos.11.0", "macosx_11_0_x86_64"),
    "macos_arm64": ("aarch64-macos.11.0", "macosx_11_0_arm64"),
    "windows_x86_64": ("x86_64-windows-gnu", "win_amd64"),
}
"""Name of a platform in zig, and in wheels."""

WIDTHS = (4, 8)
"""Numbers of lanes; on ARM the compiler uses two registers for four doubles."""

NAME = libraries.PREBUILT_PACKAGE


@dataclass(frozen=True)
class Text:
    """C code of a library.

    Attributes:
        name: Name of the file without suffix.
        text: C code.
    """

    name: str
    text: str

    def fits(self, target: str) -> bool:
        """Return whether machines of a target can use the library."""
        return "x86_64" in target or "_lanes8-" not in self.name


def texts_of(robots: Sequence[str], everything: bool) -> list[Text]:
    """Return the C code that all uses of the robots generate."""
    texts: dict[str, str] = {}
    libraries.text_listeners.append(texts.__setitem__)
    found_wide = machine_lanes()
    with tempfile.TemporaryDirectory() as cache:
        changed = {"CASADI_IK_CACHE": cache, "CASADI_IK_CFLAGS": "-O0", "CASADI_IK_COMPILE": "wait"}
        os.environ.update(changed)
        for width in WIDTHS:
            if width > found_wide:
                say(f"this machine has no registers for {width} doubles: omitted")
                continue
            os.environ["CASADI_IK_LANES"] = str(width)
            for name in robots:
                robot = ik.load_robot(name)
                for purpose, use in kernel_uses(robot, everything):
                    use()
                    say(f"{name}, {width} lanes: {purpose}")
        del os.environ["CASADI_IK_LANES"]
        _ = machine_lanes()
    texts.pop("", None)
    return [Text(name, text) for name, text in sorted(texts.items())]


def compile_texts(texts: Sequence[Text], target: str, folder: Path, jobs: int) -> None:
    """Compile every library for a target."""
    command = (sys.executable, *ZIG, "-target", TARGETS[target][0])
    zig = Compiler(command, "", (*FLAGS, "-s"))

    def build(text: Text) -> None:
        with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
            source = Path(temporary) / "kernel.c"
            source.write_text(text.text, encoding="utf-8")
            zig.build(source, Path(temporary) / "kernel.so")
            (Path(temporary) / "kernel.so").replace(folder / f"{text.name}.so")

    with ThreadPoolExecutor(jobs) as threads:
        for i, _ in enumerate(threads.map(build, texts), start=1):
            if i % 20 == 0 or i == len(texts):
                say(f"{target}: {i} of {len(texts)}")


def wheel(files: dict[str, bytes], target: str, out: Path) -> Path:
    """Write the wheel of a target."""
    version, tag = ik.__version__, f"py3-none-{TARGETS[target][1]}"
    info = f"{NAME}-{version}.dist-info"
    metadata = (
        f"Metadata-Version: 2.1\nName: casadi-ik-kernels\nVersion: {version}\n"
        "Summary: Kernels of casadi-ik compiled ahead\nLicense: BSD-3-Clause\n"
        f"Requires-Dist: casadi-ik=={version}\n"
        "Description-Content-Type: text/markdown\n"
        "\n"
        f"Prebuilt kernels for [casadi-ik](https://github.com/casadi-ik/casadi_ik) {version}.\n"
    )
    content_by_name = {f"{NAME}/{name}": content for name, content in files.items()} | {
        f"{info}/METADATA": metadata.encode(),
        f"{info}/WHEEL": (
            f"Wheel-Version: 1.0\nGenerator: build_kernels\nRoot-Is-Purelib: false\nTag: {tag}\n"
        ).encode(),
    }
    rows = [
        f"{name},sha256={_digest(content)},{len(content)}"
        for name, content in content_by_name.items()
    ]
    record = "\n".join([*rows, f"{info}/RECORD,,", ""])
    path = out / f"{NAME}-{version}-{tag}.whl"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, content in (content_by_name | {f"{info}/RECORD": record.encode()}).items():
            archive.writestr(zipfile.ZipInfo(name, (2020, 1, 1, 0, 0, 0)), content)
    return path


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


def say(text: str) -> None:
    """Print without buffering."""
    print(text, flush=True)


def main() -> None:
    """Build the wheels that the command line names."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("robots", nargs="*", help=f"instead of {', '.join(ROBOTS)}")
    parser.add_argument("--target", nargs="*", choices=TARGETS, default=list(TARGETS))
    parser.add_argument("--out", type=Path, default=Path("dist"))
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--all", action="store_true", help="also of scenes, ranking, motions, logs")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    texts = texts_of(options.robots or list(ROBOTS), options.all)
    for target in options.target:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / "kernels"
            folder.mkdir()
            compile_texts(
                [text for text in texts if text.fits(target)], target, folder, options.jobs
            )
            files = {"__init__.py": b'"""Kernels of casadi-ik, compiled ahead."""\n'}
            files["made_for"] = package_sources().encode()
            files |= {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
        path = wheel(files, target, options.out)
        say(f"{path}: {len(files) - 2} libraries, {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
