# SPDX-License-Identifier: Apache-2.0
"""One package for colcon (ament_python) and for pip; the requirement lists live in requirements/*.in."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "cvcdepth_ros"
SHARE = Path("share") / NAME
TEMPLATES = ["reports/templates/*"]
# `colcon build --symlink-install` runs a link to this file elsewhere.
REQUIREMENTS = Path(__file__).resolve().parent / "requirements"


def requirements(list_name: str) -> list[str]:
    """Read the requirements named in requirements/LIST_NAME.in."""
    lines = (REQUIREMENTS / f"{list_name}.in").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def shared_files(*folders: str) -> list[tuple[str, list[str]]]:
    """List every file below the folders as setuptools' data_files for share/cvcdepth_ros."""
    found = [path for folder in folders for path in sorted(Path(folder).rglob("*")) if path.is_file()]
    return [(str(SHARE / path.parent), [str(path)]) for path in found if "__pycache__" not in path.parts]


setup(
    name=NAME,
    version="0.1.0",
    description="Live surround depth for robots and cars: calibrated cameras in, metric depth and point clouds out",
    license="Apache-2.0",
    author="The cvcdepth_ros authors",
    maintainer="The cvcdepth_ros authors",
    maintainer_email="maintainers@cvcdepth.invalid",
    python_requires=">=3.10",
    packages=find_packages(include=["cvcdepth_core*", "cvcdepth_ros*"]),
    package_data={"cvcdepth_core": ["py.typed", "models/*"], "cvcdepth_ros": ["py.typed", *TEMPLATES]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (str(SHARE), ["package.xml"]),
        *shared_files("config", "launch"),
    ],
    # numpy 2 works with torch from 2.3 on.
    install_requires=["torch>=2.3", *requirements("core")],
    extras_require={
        "ros-jazzy": requirements("ros"),
        **{
            name: requirements(name)
            for name in ("s3", "report", "fleet", "tensorboard", "onnx", "openvino", "video", "worlds")
        },
    },
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "surround_depth_node = cvcdepth_ros.surround_depth_node:main",
            "bag_replay = cvcdepth_ros.bag_replay:main",
            "cvcdepth = cvcdepth_ros.bag_replay:main",
        ],
    },
)
