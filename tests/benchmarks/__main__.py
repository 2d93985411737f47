"""Every benchmark in turn: ``python -m tests.benchmarks``."""

from tests.benchmarks import forecast, imaging, speed, surfaces
from tests.benchmarks.record import recording

surfaces.main([])
with recording("forecast"):
    forecast.main()
with recording("speed"):
    speed.main()
with recording("imaging"):
    imaging.main([])
