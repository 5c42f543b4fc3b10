"""Settings that all tests share."""

from hypothesis import settings

# A first call compiles kernels or loads libraries, so time says nothing; the same examples every
# time, so that a failure is there again on the next run.
settings.register_profile("beatfield", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("beatfield")
