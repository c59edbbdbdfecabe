"""Batches: many command lines, each a process of its own, and a state that outlives whoever runs them.

items and lines say what is to be done, state what has been done; crew, child and room run it; report, page and tables
tell what came of it. Nothing here knows a scene.
"""
