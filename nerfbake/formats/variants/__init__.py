"""Write a scene in several representations as one stage of USD."""
