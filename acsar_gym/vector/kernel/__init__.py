"""The compiled loops of a batch: one env step of many planar robots.

Robots are kept in blocks, see `layout`, and go through a step block by block. The functions of the
single environment are compiled into the
loops: motors and tyres of `dynamics`, the equations of `kinematics` and `odometry`, the safety
`rules`, and the task's methods. The single environment emulates the firmware with bytes and queues;
here the same timing is computed with numbers: a command takes effect after `COMMAND_LOOPS` loops of
the firmware, a feedback line is made every `FEEDBACK_LOOPS` and is read `DELAY_LOOPS` later. Both
are rounded to the wire's two decimals.

In functions of a block, `robots` is its record, `i` a robot's place in it, and `first` to `last`
are some of its places; elsewhere they are robots of the batch. `slot` is a place in a ring buffer.
"""
