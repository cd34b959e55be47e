"""Package metadata; it stands here and not in pyproject.toml because colcon reads it from here."""

from setuptools import find_packages, setup

setup(
    name="gr-ros2",
    version="0.1.0",
    description="Native ROS 2 topics over any GNU Radio physical layer, without IP",
    long_description=open("README.md", encoding="utf-8").read(),
    long_description_content_type="text/markdown",
    license="GPL-3.0-or-later",
    python_requires=">=3.10",
    packages=find_packages(include=["gr_ros2", "gr_ros2.*"]),
    package_data={
        "gr_ros2": [
            "py.typed",
            "grc/*.yml",
            "examples/*",
            "scenarios/*",
            "experiment/templates/*",
            "dashboard/templates/*",
            "compression/dictionaries/*",
        ]
    },
    install_requires=[
        "backports.zstd>=1.8; python_version < '3.14'",
        "click>=8.1,<9",
        "cyclonedds==11.0.1",
        "jinja2>=3.1,<4",
        "matplotlib>=3.9,<4",
        "numpy>=1.21.5,<2",
        "pyarrow>=17",
        "plotext>=5.3,<6",
        "pydantic>=2.10,<3",
        "pyyaml>=6,<7",
        "rich>=14",
        "rosbags>=0.11,<0.12",
    ],
    extras_require={"dashboard": ["bokeh>=3.8,<4"]},
    entry_points={"console_scripts": ["gr-ros2 = gr_ros2.cli.main:main"]},
    classifiers=[
        "License :: OSI Approved :: GNU General Public License v3 or later (GPLv3+)",
        "Programming Language :: Python :: 3",
        "Operating System :: POSIX :: Linux",
    ],
)
