/* Four motors with their encoders, and where the robot would be with them. */
#ifndef WHEELS_H
#define WHEELS_H

#include <stdint.h>

#define WHEELS 4
#define COUNTS_PER_TURN 1320
#define FULL_SPEED 36.0 /* with full PWM [rad/s] */

struct wheels {
    double gain[WHEELS];          /* factor of FULL_SPEED */
    double time_constant[WHEELS]; /* [s] */
    int held[WHEELS];             /* a blocked wheel */
    double speed[WHEELS];         /* [rad/s] */
    double angle[WHEELS];         /* [rad] */
    double pose[3];               /* x [m], y [m], theta [rad] */
};

/* Let `dt` seconds pass with these duties of -1 to 1. */
void wheels_step(struct wheels *wheels, const double duty[WHEELS], double dt);

/* Return how many edges of its encoder a wheel has passed. */
int64_t wheels_count(const struct wheels *wheels, int wheel);

#endif
