/* Four motors with their encoders, and where the robot would be with them. */
#ifndef WHEELS_H
#define WHEELS_H

#include <stdint.h>

#define WHEELS 4

struct wheels {
    double counts_per_turn;       /* edges of an encoder */
    double full_speed;            /* with full PWM [rad/s] */
    double gain[WHEELS];          /* factor of full_speed */
    double time_constant[WHEELS]; /* [s] */
    double way[WHEELS];           /* of its encoder: 1, or -1 for a reversed one */
    double load[WHEELS];          /* speed that a slope or a hand would give it without power [rad/s] */
    int held[WHEELS];             /* turns at `held_at`, whatever its motor does */
    double held_at[WHEELS];       /* [rad/s]; 0 for a blocked wheel */
    double speed[WHEELS];         /* [rad/s] */
    double angle[WHEELS];         /* [rad] */
    double pose[3];               /* x [m], y [m], theta [rad] */
};

/* Let `dt` seconds pass with these duties of -1 to 1. */
void wheels_step(struct wheels *wheels, const double duty[WHEELS], double dt);

/* Return how many edges of its encoder a wheel has passed. */
int64_t wheels_count(const struct wheels *wheels, int wheel);

#endif
