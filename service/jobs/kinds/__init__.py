"""The kinds of jobs: one file each, with a `KIND` that gives its payload and handler."""

from service.base.discovery import modules_of
from service.jobs.kind import Kinds

KINDS: Kinds = {module.KIND.name: module.KIND for module in modules_of("service.jobs.kinds")}
"""All kinds of jobs by name."""
