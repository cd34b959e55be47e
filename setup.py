"""Package metadata; it stands here and not in pyproject.toml because colcon reads it from here.

``GR_ROS2_WHEEL=x86_64`` or ``aarch64`` builds for every Python at once, with a compiler for that architecture: see
tools/make-wheels.
"""

import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

WHEEL_FOR = os.environ.get("GR_ROS2_WHEEL", "")

CYCLONEDDS = "cyclonedds==11.0.1"
NEWEST_CYCLONEDDS = (3, 13)
"""The last Python that its wheels are for. Their C library, which is all that is used, needs none: for a newer Python
the build takes it out of the last wheel, and it becomes a part of ours."""
LIBDDSC = Extension("gr_ros2.middleware.libddsc", sources=[], py_limited_api=bool(WHEEL_FOR))

MACHINE = WHEEL_FOR or platform.machine()

KERNELS = "gr_ros2/phy/kernels"
COMPILE = [
    "-std=c++17",
    "-O3",
    "-fvisibility=hidden",
    # What lets sums be taken in any order. Never -ffast-math: linked with it, a library turns denormals off for the
    # whole process, and what is compiled with it takes NaN for a number.
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-Wno-psabi",  # vectors pass between functions of one file alone, so how they do is nobody's matter
]
VARIANTS = {"_baseline": []} | ({"_avx2": ["-mavx2", "-mfma"]} if MACHINE in ("x86_64", "AMD64") else {})
"""Libraries of compiled kernels: for every processor of the architecture (64-bit ARM has NEON), and for newer ones."""

LABORATORY = [
    "jinja2>=3.1,<4",
    "matplotlib>=3.9,<4",
    "plotext>=5.3,<6",
    "pyarrow>=17,<26; python_version < '3.13'",  # 26 needs numpy 2
    "pyarrow>=17; python_version >= '3.13'",
]
"""What experiments and their reports need, and a robot's link does not."""

(version,) = re.findall(r'^__version__ = "(.+)"$', Path("gr_ros2/__init__.py").read_text(encoding="utf-8"), re.M)


def files(pattern: str) -> list[str]:
    return [str(path) for path in sorted(Path().glob(pattern))]


def kernels(variant: str, flags: list[str]) -> Extension:
    """One library; without a compiler it is left out, and numpy does its work."""
    return Extension(
        f"gr_ros2.phy.kernels.{variant}",
        sources=files(f"{KERNELS}/*.cpp"),
        depends=files(f"{KERNELS}/*.h"),
        extra_compile_args=[*COMPILE, *flags],
        py_limited_api=bool(WHEEL_FOR),  # the kernels do not use Python, so one file is for every version of it
        extra_link_args=["-s"] if WHEEL_FOR else [],
        language="c++",
        optional=not WHEEL_FOR,
    )


def fetch_libddsc(place: Path) -> None:
    """Write the C library of the last Python's wheel to a file."""
    last = ".".join(map(str, NEWEST_CYCLONEDDS))
    with TemporaryDirectory() as folder:
        download = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--only-binary=:all:"]
        subprocess.run([*download, "--python-version", last, "--dest", folder, CYCLONEDDS], check=True)
        (wheel,) = Path(folder).glob("cyclonedds-*.whl")
        with ZipFile(wheel) as files:
            (library,) = (name for name in files.namelist() if name.startswith("cyclonedds.libs/libddsc"))
            with files.open(library) as source, place.open("wb") as target:
                shutil.copyfileobj(source, target)


class BuildLibraries(build_ext):
    """Objects of each variant of the kernels in a folder of its own; the DDS library comes ready."""

    def build_extension(self, ext: Extension) -> None:
        if ext is LIBDDSC:
            place = Path(self.get_ext_fullpath(ext.name))
            place.parent.mkdir(parents=True, exist_ok=True)
            fetch_libddsc(place)
            return
        shared, self.build_temp = self.build_temp, str(Path(self.build_temp) / ext.name.rpartition(".")[2])
        try:
            super().build_extension(ext)
        finally:
            self.build_temp = shared


setup(
    name="gr-ros2",
    version=version,
    description="Native ROS 2 topics over any GNU Radio physical layer, without IP",
    long_description=(Path(__file__).resolve().parent / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license="GPL-3.0-or-later",
    python_requires=">=3.10",
    packages=find_packages(include=["gr_ros2*"]),
    package_data={
        "gr_ros2": [
            "py.typed",
            "grc/*.yml",
            "wireshark/*",
            "examples/*",
            "registries/*",
            "dashboard/templates/*",
            "compression/dictionaries/*",
        ],
        "gr_ros2_lab": [
            "py.typed",
            "scenarios/*",
            "sweeps/*",
            "losses/*",
            "losses/*/*",
            "race/*.cpp",
            "race/*.hpp",
            "report/templates/*",
        ],
    },
    ext_modules=[
        *(kernels(variant, flags) for variant, flags in VARIANTS.items()),
        *([LIBDDSC] if MACHINE == "x86_64" and (WHEEL_FOR or sys.version_info[:2] > NEWEST_CYCLONEDDS) else []),
    ],
    cmdclass={"build_ext": BuildLibraries},
    options={"bdist_wheel": {"py_limited_api": "cp310", "plat_name": f"linux_{WHEEL_FOR}"}} if WHEEL_FOR else {},
    # What a ROS 2 workspace looks for; GRC finds the blocks in share by the hook of colcon.pkg.
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/gr_ros2"]),
        ("share/gr_ros2", ["package.xml"]),
        ("share/gr_ros2/launch", files("launch/*.py")),
        ("share/gr_ros2/grc", files("gr_ros2/grc/*.yml")),
        ("share/gr_ros2/hook", files("resource/hook/*")),
        ("lib/gr_ros2", ["resource/link"]),
    ],
    install_requires=[
        "apsw>=3.46",
        "backports.zstd>=1.8; python_version < '3.14'",
        "click>=8.1,<9",
        "cryptography>=41",
        # PyPI has neither a wheel of it for Linux on ARM nor the C sources to make one from.
        f"{CYCLONEDDS}; python_version < '3.14' and (sys_platform != 'linux' or platform_machine == 'x86_64')",
        # That of the distribution's GNU Radio: Debian's and Ubuntu's was built for numpy 2 from Python 3.13 on.
        "numpy>=1.21.5,<2; python_version < '3.13'",
        "numpy>=2,<3; python_version >= '3.13'",
        "packaging>=22",
        "pydantic>=2.10,<3",
        "pyyaml>=6,<7",
        "rich>=14",
        "pyserial>=3.5,<4",
        "rosbags>=0.11,<0.12",
    ],
    extras_require={
        "audio": ["sounddevice>=0.5,<0.6"],
        "dashboard": ["bokeh>=3.8,<4", "jinja2>=3.1,<4"],
        "foxglove": ["foxglove-sdk>=0.30,<1"],
        "lab": LABORATORY,
        "sweep": [*LABORATORY, "distributed>=2024.8"],
        # Each release has wheels for some versions of Python only.
        "video": ["av>=17.1,<20"],
        "zenoh": ["eclipse-zenoh>=1.10,<2"],
    },
    entry_points={"console_scripts": ["gr-ros2 = gr_ros2.cli.__main__:main"]},
    classifiers=[
        "Programming Language :: Python :: 3",
        "Operating System :: POSIX :: Linux",
    ],
)
