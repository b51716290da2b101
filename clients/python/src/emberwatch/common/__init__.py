"""Shared by the whole package: checks of arguments, paths, constants."""
