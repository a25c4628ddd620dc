"""The compiled loops of a batch: one env step of many planar robots.

Robots are kept in blocks, see `layout`, and go through a step block by block. The functions of the
single environment are compiled into the loops: motors and tyres of `physics.model`, the equations
of `kinematics` and `odometry`, the safety `rules`, and the task's methods. The single environment
emulates the firmware with bytes and queues. Here the same timing is computed with numbers: a
command takes effect after `command_loops` loops of the firmware, a feedback line is made every
`feedback_loops` and is read `feedback_delay` later. Both are rounded to the wire's two decimals.

In all functions, `robots` is the record of a block, `count` how many robots it has, and `i` the
place of one among them, and `robot` is its number in the batch. Loops that Python calls get blocks
`first` to `last`. `slot` is a place in a ring buffer.
"""
