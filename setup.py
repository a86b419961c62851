"""The one thing setup.cfg cannot say: the kernels in C, which torch_dpc works without, slower."""

from setuptools import Extension, setup

kernels = Extension(
    "torch_dpc.solve._kernels",
    ["torch_dpc/solve/_kernels.c"],
    depends=["torch_dpc/solve/_system.h", "torch_dpc/solve/_boxes.h", "torch_dpc/solve/_batch.h"],
    extra_compile_args=["-O3", "-Wno-psabi"],  # vectors are passed between inlined functions alone
    optional=True,
)

setup(ext_modules=[kernels])
