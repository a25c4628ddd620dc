#include "guard.h"

#include <stdlib.h>

#include "config.h"
#include "motors.h"
#include "speed.h"

#define TURN 6.283185307179586
#define BLOCK_RATE 50 /* direction is judged in blocks of 20 ms [Hz] */
#define BLOCKS 6      /* in a row that tell: 0.12 s, and the rest of a block before */
#define BLOCK_LOOPS (LOOP_RATE / BLOCK_RATE)
#define IN_BLOCK(speed) ((speed) * (COUNTS_PER_TURN / TURN / BLOCK_RATE)) /* counts, of [rad/s] */

/* What counts as turning: more than jitter of an edge, and more than play of the gears. */
#define SLOWEST (IN_BLOCK(0.5) < 3 ? 3 : (int16_t)IN_BLOCK(0.5))
#define HARD ((int16_t)(CORRECTION_SHARE * 7 / 8 * FULL_DUTY)) /* of a duty that needs an answer */
#define STALL_LOOPS ((uint16_t)((uint32_t)STALL_MS * LOOP_RATE / 1000))

_Static_assert(LOOP_RATE >= BLOCK_RATE, "LOOP_RATE: at least 50");
_Static_assert((uint32_t)STALL_MS * LOOP_RATE / 1000 < 65536,
               "STALL_MS: must be less than 65536 loops");

/* Whether a wheel runs away that turned against its motor by so many counts in this block.
 *
 * One that is braked, as it reverses, gets slower. One that turns the way it shall may be braked
 * for ever, as downhill; before it is proven, only to about the speed that it shall have. One that
 * was proven and turns back is pushed, by a hand or a slope, unless it has at least half the speed
 * that its duty would give. */
static uint8_t runs_away(const struct guard *guard, int16_t against, int16_t duty,
                         int32_t reference)
{
    int16_t wanted = (reference >> 12) * BLOCK_LOOPS >> (SPEED_BITS - 12);
    uint8_t back = (duty < 0) == (reference < 0);
    if (against < SLOWEST || against < guard->fastest - guard->fastest / 8 - 1)
        return 0;
    if (!guard->proven)
        return back || against > 2 * abs(wanted) + 2 * SLOWEST;
    return back && (int32_t)against * 2 * FULL_DUTY >= abs(duty) * (int32_t)IN_BLOCK(FULL_SPEED);
}

static void judge_direction(struct guard *guard, int16_t duty, int32_t reference)
{
    int16_t with = duty < 0 ? -guard->turned : guard->turned;
    guard->with = duty != 0 && with >= SLOWEST ? guard->with + 1 : 0;
    if (guard->with >= BLOCKS)
        guard->proven = 1;
    if (duty == 0 || !runs_away(guard, -with, duty, reference)) {
        guard->against = guard->fastest = 0;
        return;
    }
    if (-with > guard->fastest)
        guard->fastest = -with;
    if (++guard->against >= BLOCKS)
        guard->cut = CUT_CONTRARY;
}

static void judge_stall(struct guard *guard, int16_t turned, int16_t duty)
{
    guard->moved += turned;
    if (abs(duty) <= HARD || abs(guard->moved) > 1)
        guard->still = guard->moved = 0;
    else if (++guard->still >= STALL_LOOPS)
        guard->cut = CUT_STALLED;
}

uint8_t guard_step(struct guard *guard, int16_t turned, int16_t duty, int32_t reference)
{
    judge_stall(guard, turned, duty);
    guard->turned += turned;
    if (++guard->loops >= BLOCK_LOOPS) {
        judge_direction(guard, duty, reference);
        guard->turned = 0;
        guard->loops = 0;
    }
    return guard->cut;
}

void guard_command(struct guard *guard, int32_t before, int32_t target)
{
    if (target == 0 || (guard->cut == CUT_STALLED && (target < 0) != (before < 0)))
        guard->cut = NOT_CUT;
}
