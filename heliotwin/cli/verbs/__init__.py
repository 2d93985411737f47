"""The verbs of `heliotwin`, one file for each group, each with its `app`.

Verbs import the tracer's libraries only when they need them, because these take seconds to load.
"""
