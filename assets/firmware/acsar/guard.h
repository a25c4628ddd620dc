/* Cuts a motor that its encoder contradicts.
 *
 * A wheel that turns against its motor's torque, and isn't braked by it, has a reversed encoder or
 * reversed cables: the speed loop would drive it to full speed. A motor that pulls hard without any
 * edge is stalled, or its encoder is dead: it would heat up, or race.
 */
#ifndef GUARD_H
#define GUARD_H

#include <stdint.h>

enum cut { NOT_CUT, CUT_CONTRARY, CUT_STALLED };

struct guard {
    uint8_t cut;      /* why the motor is cut */
    uint8_t loops;    /* of this block */
    int16_t turned;   /* in this block [counts] */
    uint8_t with;     /* blocks in a row in which the wheel turned as its motor pulled */
    uint8_t proven;   /* it has done so for long enough, since power-up */
    uint8_t against;  /* blocks in a row in which it turned the other way */
    int16_t fastest;  /* of these blocks [counts] */
    uint16_t still;   /* loops for which the motor has pulled hard in vain */
    int16_t moved;    /* in them [counts] */
};

/* Look at one loop; returns whether the motor is cut. `reference` is how fast the wheel shall turn
 * [counts per loop, 2^-SPEED_BITS]. */
uint8_t guard_step(struct guard *guard, int16_t turned, int16_t duty, int32_t reference);

/* Look at a command: zero ends every cut, and the other direction that of a stalled motor. */
void guard_command(struct guard *guard, int32_t before, int32_t target);

#endif
