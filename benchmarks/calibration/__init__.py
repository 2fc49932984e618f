"""Are bad networks and beliefs flagged, and good ones not?"""
