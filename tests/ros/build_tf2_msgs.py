"""Compile tests/ros/tf2_msgs into the virtual environment that runs this file.

No wheel has tf2_msgs. Needs a C and a C++ compiler. cmake and ninja may be of pip.
"""

import os
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path

import numpy as np

PACKAGE = Path(__file__).parent / "tf2_msgs"
PYTHON = "python{}.{}".format(*sys.version_info)
# Where the computer that built the wheels had its Python, which their cmake files name.
WHEELS_PYTHON = "/opt/python/cp{0}{1}-cp{0}{1}".format(*sys.version_info)
INCLUDES = {
    f"{WHEELS_PYTHON}/include/{PYTHON}": sysconfig.get_path("include"),
    f"{WHEELS_PYTHON}/lib/{PYTHON}/site-packages/numpy/_core/include": np.get_include(),
}


def name_own_includes(prefix: Path) -> None:
    """Name the include folders of this Python in the cmake files of the message wheels."""
    for exported in prefix.glob("share/*/cmake/*_pyExport.cmake"):
        text = exported.read_text()
        for wheels_folder, folder in INCLUDES.items():
            text = text.replace(wheels_folder, folder)
        exported.write_text(text)


def main() -> None:
    """Configure, compile and install."""
    prefix = Path(sys.prefix)
    name_own_includes(prefix)
    environment = os.environ | {
        "AMENT_PREFIX_PATH": str(prefix),
        "CMAKE_PREFIX_PATH": str(prefix),
        "PATH": f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}",
    }

    with tempfile.TemporaryDirectory() as build:
        configure = ["cmake", "-S", str(PACKAGE), "-B", build, "-G", "Ninja"]
        configure += [f"-DCMAKE_INSTALL_PREFIX={prefix}", "-DBUILD_TESTING=OFF"]
        configure += [f"-DPython3_EXECUTABLE={sys.executable}"]
        for command in configure, ["cmake", "--build", build, "--target", "install"]:
            done = subprocess.run(
                command,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                check=False,
            )
            if done.returncode:
                sys.exit(
                    f"{done.stdout}\nbuild_tf2_msgs: {' '.join(command[:2])} failed, see above: it "
                    "needs a C and a C++ compiler and Python's headers"
                )


if __name__ == "__main__":
    main()
