"""Do exports open in ArviZ of both generations?"""
