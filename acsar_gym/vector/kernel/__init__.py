"""The compiled loops of a batch: one env step of many planar robots.

Robots are columns of one float64 array and their numbers are its rows, so that every loop over
robots runs over contiguous memory. The functions of the single environment are compiled into the
loops: motors and tyres of `dynamics`, the equations of `kinematics` and `odometry`, the safety
`rules`, and the task's methods. The single environment emulates the firmware with bytes and queues;
here the same timing is computed with numbers: a command takes effect after `COMMAND_LOOPS` loops of
the firmware, a feedback line is made every `FEEDBACK_LOOPS` and is read `DELAY_LOOPS` later. Both
are rounded to the wire's two decimals.

In all functions, `first` and `last` are a slice of the robots, and `slot` is a place in a ring
buffer.
"""
