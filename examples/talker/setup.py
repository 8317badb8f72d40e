from setuptools import setup

setup(
    name="talker",
    version="1.0.0",
    packages=["talker"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/talker"]),
        ("share/talker", ["package.xml"]),
        ("share/talker/launch", ["launch/talker.launch.py"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="taskd",
    maintainer_email="taskd@example.org",
    description="Publishes a greeting and answers a service",
    license="Apache-2.0",
    entry_points={"console_scripts": ["talker = talker.node:main"]},
)
