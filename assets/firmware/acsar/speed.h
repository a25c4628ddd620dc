/* The speed loop of one wheel, in whole numbers.
 *
 * The set point ramps to the target. The reference, a first-order lag of the set point with
 * TIME_CONSTANT, is how the wheel shall turn; feed-forward makes a nominal motor do that, and a PI
 * controller corrects what a real one does otherwise. The sum of the speed error is the difference
 * between the reference's angle and the wheel's, so that no count is lost and nothing drifts.
 */
#ifndef SPEED_H
#define SPEED_H

#include <stdint.h>

#include "guard.h"

#define SPEED_BITS 24

struct wheel {
    int32_t target;    /* [counts per loop, 2^-SPEED_BITS] */
    int32_t set_point;
    int32_t reference;
    int32_t error;     /* reference's angle less the wheel's [counts, 2^-16] */
    int32_t slow;      /* `error` through a low-pass filter */
    uint16_t count;    /* of the encoder, at the last step */
    int16_t rest;      /* of the duty, less than one step of the PWM: used in the next loop */
    struct guard guard;
};

/* Set the target [0.01 rad/s], at most MAX_SPEED. */
void speed_command(struct wheel *wheel, int16_t speed);

/* Run one loop; returns the duty of the motor. `count` is the encoder's. */
int16_t speed_step(struct wheel *wheel, uint16_t count);

/* Convert the counts of a feedback window to a speed [0.01 rad/s]. */
int16_t speed_of(int16_t counts);

#endif
