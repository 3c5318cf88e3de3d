"""The source folder is called src, the package see2act; this says so to setuptools."""

from setuptools import find_packages, setup

packages = ["see2act", *(f"see2act.{name}" for name in find_packages("src")), "see2act.conf"]
setup(packages=packages, package_dir={"see2act": "src", "see2act.conf": "conf"})
