"""Hypothesis without a folder of its own; a failure prints how to have it again."""

from hypothesis import settings

settings.register_profile("roomcast", database=None, print_blob=True)
settings.load_profile("roomcast")
