"""How many threads one computation takes: one, unless the operator's ``OMP_NUM_THREADS`` says otherwise.

A service computes at several things at a time (``HELIOTWIN_PARALLEL_COMPUTATIONS``), and each of them is many small
steps: a matrix of some hundred rows, the transform of an image of 64 x 64 pixels. Threads of a library share such a
step and then spin until the last of them is done; where another process has a core, that one comes back a time slice
later, and every step waits for it. `tests.benchmarks.busy` measures it. A refinement alone fits halves of its images
two at a time (`model.refinement`): they share no step, and where there is no second core they take turns.
"""

import os

# What numpy's and SciPy's OpenBLAS, PyTorch's OpenMP, MKL and OpenCV read, each once, when it is loaded.
_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def limit() -> None:
    """Say so to the libraries of linear algebra, before they are loaded; processes that this one starts inherit it.

    It is said in the environment, and not to each library, because loading one takes seconds that most verbs save.
    """
    count = os.environ.get("OMP_NUM_THREADS", "1")
    for name in _VARIABLES:
        os.environ.setdefault(name, count)
