"""Measure what the stages made against truth."""
