#include "wheels.h"

#include <math.h>

#define RADIUS 0.05
#define SEPARATION (0.3 * 1.5378)
#define AT_REST 1e-3 /* static friction holds a wheel slower than this, without power [rad/s] */

void wheels_step(struct wheels *wheels, const double duty[WHEELS], double dt)
{
    for (int i = 0; i < WHEELS; i++) {
        double before = wheels->speed[i];
        double top = duty[i] * wheels->full_speed * wheels->gain[i] + wheels->load[i];
        double after = top + (before - top) * exp(-dt / wheels->time_constant[i]);
        if (wheels->held[i])
            after = wheels->held_at[i];
        else if (duty[i] == 0.0 && wheels->load[i] == 0.0 && fabs(after) < AT_REST)
            after = 0.0;
        wheels->speed[i] = after;
        wheels->angle[i] += (before + after) / 2.0 * dt;
    }
    double right = (wheels->speed[0] + wheels->speed[3]) / 2.0 * RADIUS;
    double left = (wheels->speed[1] + wheels->speed[2]) / 2.0 * RADIUS;
    wheels->pose[0] += (left + right) / 2.0 * cos(wheels->pose[2]) * dt;
    wheels->pose[1] += (left + right) / 2.0 * sin(wheels->pose[2]) * dt;
    wheels->pose[2] += (right - left) / SEPARATION * dt;
}

int64_t wheels_count(const struct wheels *wheels, int wheel)
{
    double turns = wheels->way[wheel] * wheels->angle[wheel] / (2.0 * M_PI);
    return (int64_t)floor(turns * wheels->counts_per_turn);
}
