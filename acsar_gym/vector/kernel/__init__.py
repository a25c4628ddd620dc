"""One env step of many planar robots: the loops behind `vector.py`.

Robots are columns of one float64 array, their numbers are its rows, so that every loop over robots
runs over contiguous memory. The functions are the ones that the single environment uses, compiled:
motors and tyres of `dynamics`, equations of `kinematics` and `odometry`, the task of `tasks`. What
the firmware's twin does with bytes and queues is done with numbers here: a command takes effect
after `command_loops` loops of the firmware, a feedback line is made every `feedback_loops` and is
read `delay_loops` later, both rounded to the wire's two decimals.
"""
