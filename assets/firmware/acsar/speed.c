#include "speed.h"

#include "config.h"
#include "motors.h"

#define TURN 6.283185307179586
#define ROUNDED(number) ((int32_t)((number) + 0.5))

#define COUNTS_PER_LOOP(speed) ((speed) * (COUNTS_PER_TURN / TURN / LOOP_RATE)) /* of [rad/s] */
#define SPEED(speed) ROUNDED(COUNTS_PER_LOOP(speed) * (1L << SPEED_BITS))

/* Duties are computed in parts of a PWM step, so that small corrections count. */
#define DUTY_BITS 7
#define DUTY_MOST ((int32_t)FULL_DUTY << DUTY_BITS)
#define DUTY(speed) ((speed) * DUTY_MOST / FULL_SPEED) /* of a speed [rad/s] */

#define RAMP SPEED(ACCELERATION / LOOP_RATE)
#define BLEND ROUNDED(65536 * (1.0 - __builtin_exp(-1.0 / (LOOP_RATE * TIME_CONSTANT))))
#define BLEND_SHIFT 9
#define FORWARD ROUNDED(DUTY(1.0) / COUNTS_PER_LOOP(1.0))
#define RADIAN (TURN / COUNTS_PER_TURN) /* of a count */
#define SLOW_BITS 4 /* `slow` follows with a time constant of 2^SLOW_BITS loops */
#define BY_SPEED ROUNDED(256 * DUTY(SPEED_GAIN) * RADIAN * LOOP_RATE / (1 << SLOW_BITS))
#define BY_ANGLE ROUNDED(256 * DUTY(ANGLE_GAIN) * RADIAN)
#define CORRECTION ROUNDED(DUTY_MOST * CORRECTION_SHARE)
#define MOST_ERROR ROUNDED(CORRECTION_SHARE * FULL_SPEED / ANGLE_GAIN / RADIAN * 65536)
#define PER_COUNT ROUNDED(65536 * 100 * RADIAN * FEEDBACK_RATE / WINDOW_LINES)

_Static_assert(LOOP_RATE % FEEDBACK_RATE == 0, "LOOP_RATE: must be a multiple of FEEDBACK_RATE");
_Static_assert((int32_t)COUNTS_PER_LOOP(2 * MAX_SPEED) < 127,
               "LOOP_RATE: too low for COUNTS_PER_TURN at MAX_SPEED, at most 63 counts a loop");
_Static_assert((int32_t)(COUNTS_PER_LOOP(2 * MAX_SPEED) * BLEND) < 65536 /* 2^31 less 15 bits */,
               "LOOP_RATE: too low for COUNTS_PER_TURN at MAX_SPEED and this TIME_CONSTANT");
_Static_assert((int32_t)(MAX_SPEED * 100) < 10000, "MAX_SPEED: the wire carries 99.99 rad/s");

static int32_t limited(int32_t value, int32_t most)
{
    return value > most ? most : value < -most ? -most : value;
}

void speed_command(struct wheel *wheel, int16_t speed)
{
    int32_t target = limited(speed, ROUNDED(MAX_SPEED * 100)) * SPEED(0.01);
    guard_command(&wheel->guard, wheel->target, target);
    wheel->target = target;
}

/* Let the set point ramp, and the reference follow it. */
static void lead(struct wheel *wheel)
{
    wheel->set_point += limited(wheel->target - wheel->set_point, RAMP);
    int32_t behind = wheel->set_point - wheel->reference;
    wheel->reference += (behind >> BLEND_SHIFT) * BLEND >> (16 - BLEND_SHIFT);
}

/* PI correction of the duty. The error is bounded, so that a wheel that was held doesn't race. */
static int32_t correction(struct wheel *wheel)
{
    wheel->error = limited(wheel->error, MOST_ERROR);
    int32_t fast = wheel->error - wheel->slow;
    wheel->slow += fast >> SLOW_BITS;
    int32_t duty = ((fast >> 12) * BY_SPEED >> 12) + ((wheel->error >> 8) * BY_ANGLE >> 16);
    return limited(duty, CORRECTION);
}

/* Compute the duty of a wheel that has turned by so many counts. */
static int16_t control(struct wheel *wheel, int16_t turned)
{
    wheel->error += (wheel->reference >> (SPEED_BITS - 16)) - ((int32_t)turned << 16);
    lead(wheel);
    if (wheel->target == 0 && wheel->set_point == 0) { /* stand: no current, whatever was owed */
        wheel->error = wheel->slow = wheel->rest = 0;
        return 0;
    }
    int32_t forward = (wheel->set_point >> 12) * FORWARD >> (SPEED_BITS - 12);
    int16_t duty = limited(forward + correction(wheel), DUTY_MOST) + wheel->rest;
    wheel->rest = duty & ((1 << DUTY_BITS) - 1);
    return duty >> DUTY_BITS;
}

int16_t speed_step(struct wheel *wheel, uint16_t count)
{
    int16_t turned = count - wheel->count;
    wheel->count = count;
    int16_t duty = wheel->guard.cut ? 0 : control(wheel, turned);
    if (!guard_step(&wheel->guard, turned, duty, wheel->reference))
        return duty;
    wheel->set_point = wheel->reference = 0; /* what begins when the cut ends begins anew */
    wheel->error = wheel->slow = wheel->rest = 0;
    return 0;
}

int16_t speed_of(int16_t counts)
{
    int32_t size = counts < 0 ? -(int32_t)counts : counts;
    int16_t speed = (size * PER_COUNT + 32768) >> 16;
    return counts < 0 ? -speed : speed;
}
