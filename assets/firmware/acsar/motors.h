/* PWM and direction of the four motors, for drivers with one pin of each (such as Cytron MDD). */
#ifndef MOTORS_H
#define MOTORS_H

#include "board.h"

#define FULL_DUTY 255

/* Begin with all motors off. */
void motors_begin(void);

/* Set one motor, -FULL_DUTY to FULL_DUTY; at 0 its PWM pin stays low. */
void motors_set(uint8_t wheel, int16_t duty);

#endif
