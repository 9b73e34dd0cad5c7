"""Mitsuba scenes as files: loading, instances, the scenes that come along."""
