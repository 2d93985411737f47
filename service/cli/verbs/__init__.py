"""The verbs of `heliotwin`, one file a group, each with its `app`.

What brings the tracer's libraries along is imported in the verb that needs it: they take seconds to load, and most
verbs do without them.
"""
