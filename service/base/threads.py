"""Threads per computation: one, unless ``OMP_NUM_THREADS`` is set.

The service runs several computations at a time (``HELIOTWIN_PARALLEL_COMPUTATIONS``). Each has many
small steps: a matrix with hundreds of rows, or the transform of an image of 64 x 64 pixels. A
library's threads would share such a step and spin until the last of them is done. If another
process occupies a core, that last thread returns a time slice later, and every step waits for it.
`benchmarks.busy` measures this effect. Only a refinement fits two halves of its images in
parallel (`model.refinement`). These share no step.
"""

import os

# Read once, on import, by OpenBLAS (numpy, SciPy), OpenMP (PyTorch), MKL and OpenCV.
_VARIABLES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


def limit_threads() -> None:
    """Set the number of threads of numerical libraries before their import. Child processes inherit
    it.

    Environment variables are used because importing the libraries takes seconds, which most
    commands avoid.
    """
    count = os.environ.get("OMP_NUM_THREADS", "1")
    for name in _VARIABLES:
        os.environ.setdefault(name, count)
