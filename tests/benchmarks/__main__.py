"""Every benchmark in turn: ``python -m tests.benchmarks``."""

from tests.benchmarks import forecast, imaging, speed, surfaces

forecast.main()
surfaces.main([])
speed.main()
imaging.main([])
