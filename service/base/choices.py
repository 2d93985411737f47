"""Choices that requests, the command line and the tables share; light, for every start of the command reads them."""

from typing import Literal

Method = Literal["network", "refined"]
"""How a surface is predicted."""

RoleName = Literal["read", "ingest", "operate", "admin"]
"""What a key may do; each may also do what those before it may."""
