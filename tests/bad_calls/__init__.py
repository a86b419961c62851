"""Malformed calls of the public API, room by room: each entry says what the error must name."""
