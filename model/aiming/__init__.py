"""Aim points: the most power on a receiver under the flux that it can take."""
