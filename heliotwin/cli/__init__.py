"""The command `heliotwin`: one file for each group of verbs.

The files that declare verbs (`main` and `verbs`) import at the top only what parsing and printing
need. A verb imports its libraries when it is called. Every start of the command reads all
declarations, and the tracer, the network and the web libraries take seconds to load. Without this
rule, `heliotwin keys list` would wait for them. Elsewhere only optional extras (Ray,
OpenTelemetry) are imported inside a function.
"""
