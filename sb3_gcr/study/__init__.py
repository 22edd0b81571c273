"""Studies: does resolving conflicts help, when, and on which reward?"""
