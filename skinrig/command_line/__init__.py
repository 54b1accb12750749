"""Syntax of the command line: help, options, their former names, completion."""
