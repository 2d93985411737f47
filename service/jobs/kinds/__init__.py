"""The kinds of job, one file each, with its `KIND`: what it takes, and the plain function that does it."""

from service.base.discovery import modules_of
from service.jobs.kind import Kinds

KINDS: Kinds = {module.KIND.name: module.KIND for module in modules_of("service.jobs.kinds")}
"""Every kind of job by its name."""
