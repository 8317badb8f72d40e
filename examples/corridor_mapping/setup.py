from setuptools import setup

setup(
    name="corridor_mapping",
    version="1.0.0",
    packages=["corridor_mapping"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/corridor_mapping"]),
        ("share/corridor_mapping", ["package.xml"]),
        ("share/corridor_mapping/launch", ["launch/mapping.launch.py"]),
    ],
    install_requires=["setuptools", "numpy"],
    zip_safe=True,
    maintainer="taskd",
    maintainer_email="taskd@example.org",
    description="Maps a simulated corridor with a particle filter",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "mapper = corridor_mapping.mapper:main",
            "mapping = corridor_mapping.mapping:main",
            "score = corridor_mapping.score:main",
            "simulator = corridor_mapping.simulator:main",
        ]
    },
)
