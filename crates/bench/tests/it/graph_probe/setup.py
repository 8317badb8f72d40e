from setuptools import setup

setup(
    name="graph_probe",
    version="1.0.0",
    packages=["graph_probe"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/graph_probe"]),
        ("share/graph_probe", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="taskd",
    maintainer_email="taskd@example.org",
    description="A node for tests that keeps, breaks or never makes a package's promises",
    license="Apache-2.0",
    entry_points={"console_scripts": ["probe = graph_probe.probe:main"]},
)
