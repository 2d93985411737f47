"""Surface refinement: the maximum a posteriori surface of a heliostat, by tracing its images.

Read `estimator` first; it has the equations, and its stages call the other modules.
"""

from model.refinement.estimator import refine
from model.refinement.modes import RefinementOptions

__all__ = ["RefinementOptions", "refine"]
