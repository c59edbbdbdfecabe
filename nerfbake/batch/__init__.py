"""Run many command lines, each in its own process, with a state on disk that survives interruptions.

items defines and parses the command lines. state records their attempts. crew and child run them. report writes the
results. Nothing in this package depends on scenes.
"""
