"""The processes that share a run, behind one object; the rest of the library knows of none."""
