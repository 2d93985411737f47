"""The service: eight rooms. base, drawing <- sources, store <- twin <- jobs <- web <- cli."""
