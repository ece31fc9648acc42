from setuptools import setup

NAME = "hybridkin_tracker"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tracker.launch.py"]),
        (f"share/{NAME}/config", ["config/tracker.yaml"]),
    ],
    install_requires=["setuptools", "hybridkin"],
    entry_points={"console_scripts": [f"tracker = {NAME}.node:main"]},
)
