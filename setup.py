"""The one thing setup.cfg cannot say: the kernels in C, which torch_dpc works without, slower."""

from setuptools import Extension, setup

# -Wno-psabi: vectors are passed between inlined functions alone.
FLAGS = ["-O3", "-Wno-psabi"]

setup(ext_modules=[Extension("torch_dpc._kernels", ["torch_dpc/_kernels.c"], extra_compile_args=FLAGS, optional=True)])
