"""Does a belief's flag follow its error?"""
