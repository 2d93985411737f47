"""The service: eight rooms. base, drawing <- sources, store <- twin <- jobs <- web <- cli."""

import os

from service.base import threads

# OpenCV reads this when it is loaded. It stands behind the checks of `service.sources.decode`: whatever gets past them,
# no image of more pixels is decoded.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))

threads.limit()
