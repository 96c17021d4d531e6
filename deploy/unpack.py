"""Unpacks from wheels what linking and running need: unpack.py cpu|cuda WHEELS DEST

DEST gets `site/`, with the wheels' own layout, because the libraries find each other through it
($ORIGIN/../../nvidia/...); `include`, to compile against; `lib`, to link against; and, for cuda,
`cuda`, opened at run time.
"""

import os
import shutil
import sys
import zipfile
from fnmatch import fnmatch
from pathlib import Path

WANTED = ["torch/include/*", "torch/lib/*.so*", "nvidia/*/lib/*.so*", "*.dist-info/*[Ll]icense*", "*.dist-info/*LICENSE*"]
PYTHON_ONLY = ["libtorch_python.so", "libshm.so", "libtorch_global_deps.so"]
# Opened by name from libtorch_cpu.so, which searches only its own directory.
OPENED_LATE = ["libcaffe2_nvrtc.so", "libtorch_cuda_linalg.so"]
CUDA_ONLY = ["libtorch_cuda.so", "libc10_cuda.so", "libtorch_nvshmem.so", *OPENED_LATE]
# libtorch_cpu.so needs these even where there is no GPU.
NVIDIA_FOR_CPU = ["libcudart.so.13", "libcupti.so.13"]


def wanted(member: str, flavour: str) -> bool:
    name = os.path.basename(member)
    if not any(fnmatch(member, pattern) for pattern in WANTED) or name in PYTHON_ONLY:
        return False
    if flavour == "cuda" or ".so" not in name:
        return True
    return name in NVIDIA_FOR_CPU if member.startswith("nvidia/") else name not in CUDA_ONLY


def same_file(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)


def main(flavour: str, wheels: Path, dest: Path) -> None:
    site = dest / "site"
    site.mkdir(parents=True)
    for wheel in sorted(wheels.glob("*.whl")):
        print(f"    unpacking {wheel.name}", flush=True)
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site, [name for name in archive.namelist() if wanted(name, flavour)])
        wheel.unlink()  # the disk need not hold both

    # What is linked against must not hold libtorch_cuda.so: one binary serves machines with and without a GPU.
    # Two levels down, so that $ORIGIN/../../nvidia is site/nvidia from here as well.
    link = site / "link" / "lib"
    link.mkdir(parents=True)
    torch = [path for path in (site / "torch" / "lib").iterdir() if path.name not in CUDA_ONLY or path.name in OPENED_LATE]
    nvidia = [path for path in (site / "nvidia").glob("*/lib/*") if path.name in NVIDIA_FOR_CPU]
    for path in torch + nvidia:
        same_file(path, link / path.name)
    # The real one does nothing but need libtorch_cuda.so, and GNU ld links it in even with --as-needed, because
    # symbols of libstdc++ are left in it. For linkers this text means libtorch_cpu.so.
    (link / "libtorch.so").unlink()
    (link / "libtorch.so").write_text("INPUT(-ltorch_cpu)\n")

    (dest / "include").symlink_to("site/torch/include")
    (dest / "lib").symlink_to("site/link/lib")
    if flavour == "cuda":
        (dest / "cuda").symlink_to("site/torch/lib")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
