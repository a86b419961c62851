"""The one thing that setup.cfg cannot say: the kernels in C. Without a compiler torch_dpc works too, slower."""

from glob import glob

from setuptools import Extension, setup

kernels = Extension(
    "torch_dpc.solve._kernels",
    ["torch_dpc/solve/_kernels.c"],
    depends=glob("torch_dpc/solve/*.h"),
    # psabi: vectors are passed between inlined functions alone.
    extra_compile_args=["-O3", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wno-psabi"],
    optional=True,
)

setup(ext_modules=[kernels])
