"""The command `heliotwin`: one file a group of verbs.

The files that declare verbs (`main` and what it adds to the command) import at the top only what parsing and printing
need; a verb imports what it works with when it is called. Every start of the command reads all declarations, and the
libraries of the tracer, the network and the web take seconds to load that `heliotwin keys list` would wait for.
Elsewhere in `service` only what an optional extra brings (Ray, OpenTelemetry) is imported in a function.
"""
