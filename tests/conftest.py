"""Settings of all tests."""

from hypothesis import settings

settings.register_profile("suite", max_examples=30, deadline=None)  # five minutes for all tests on two cores
settings.load_profile("suite")
