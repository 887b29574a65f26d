from glob import glob

from setuptools import setup

NAME = "graspd_ros"

setup(
    name=NAME,
    version="0.2.0",
    description="A node that detects 6-DoF grasps in depth images or point clouds with a graspd server",
    license="MIT OR Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", glob("config/*")),
        (f"share/{NAME}/launch", glob("launch/*")),
        (f"share/{NAME}/rviz", glob("rviz/*")),
    ],
    # graspd, the client, is not listed: the server's repository has it, PyPI does not.
    install_requires=["setuptools", "numpy"],
    zip_safe=True,
    entry_points={"console_scripts": [f"graspd_node = {NAME}.node:main"]},
)
