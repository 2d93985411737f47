"""What processes that tests start have loaded, and made once, when they begin (`tests.forked`)."""

import heliotwin.cli.main
import tests.faults.process
import tests.service.job_kinds
from service.jobs.kinds import KINDS
from service.web.app import collect_routes

__all__ = ["heliotwin", "tests"]

# The models of requests and answers are made with the first routes: half of what a start takes.
collect_routes(KINDS)
