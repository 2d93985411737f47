"""The service: seven packages. base, drawing <- sources, store <- twin <- jobs <- web."""

import os

from service.base import processes

# OpenCV reads this when it is loaded. It is a second limit after the checks of
# `service.sources.decode`: OpenCV decodes no image of more pixels.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(2**27))

processes.limit_threads()
