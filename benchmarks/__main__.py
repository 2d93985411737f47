"""Every benchmark in turn: ``python -m benchmarks``."""

from benchmarks import forecast, imaging, speed, surfaces
from benchmarks.record import recording

surfaces.main([])
with recording("forecast"):
    forecast.main()
with recording("speed"):
    speed.main()
with recording("imaging"):
    imaging.main([])
