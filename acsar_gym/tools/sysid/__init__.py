"""System identification.

What motors, board and wheels are like, and how far a twin is from them.
"""
