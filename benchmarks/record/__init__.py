"""Cases whose results are kept, so that a later tree can be compared with this one."""
