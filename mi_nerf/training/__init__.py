"""Fitting a radiance field to images."""
