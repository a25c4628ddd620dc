"""Diagnosis of robot, serial line and computer, with advice what to fix."""
