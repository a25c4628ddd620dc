"""The ROS 2 package: two programs and their files. Their code is that of acsar_gym by pip."""

from pathlib import Path

from setuptools import setup

SHARE = "share/acsar_gym"

setup(
    name="acsar_gym_ros",  # else it would hide what pip knows of acsar_gym
    version="0.2.0",
    description="Driver and policy nodes of acsar_gym, with launch, parameter and RViz files",
    license="MIT",
    packages=[],
    py_modules=[],
    zip_safe=True,
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/acsar_gym"]),
        (SHARE, ["package.xml"]),
        *(
            (f"{SHARE}/{folder}", sorted(map(str, Path(folder).iterdir())))
            for folder in ("config", "launch", "rviz")
        ),
    ],
    entry_points={
        "console_scripts": [
            "driver = acsar_gym.__main__:ros_driver",
            "policy = acsar_gym.__main__:ros_policy",
        ],
    },
)
