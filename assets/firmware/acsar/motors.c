#include "motors.h"

#include "config.h"

void motors_begin(void)
{
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++) {
        PWM_DUTY(wheel) = 0;
        PWM_DDR(wheel) |= 1 << PWM_BIT(wheel);
        DIRECTION_DDR(wheel) |= 1 << DIRECTION_BIT(wheel);
    }
    /* Phase-correct PWM at 3.9 kHz: a duty of 0 is no pulse at all. */
    TCCR0A = 1 << COM0A1 | 1 << COM0B1 | 1 << WGM00;
    TCCR0B = 1 << CS01;
    TCCR2A = 1 << COM2A1 | 1 << COM2B1 | 1 << WGM20;
    TCCR2B = 1 << CS21;
}

void motors_set(uint8_t wheel, int16_t duty)
{
    static const uint8_t reversed[WHEELS] = MOTOR_REVERSED;
    uint8_t backward = (duty < 0) != reversed[wheel];
    if (backward)
        DIRECTION_PORT(wheel) |= 1 << DIRECTION_BIT(wheel);
    else
        DIRECTION_PORT(wheel) &= ~(1 << DIRECTION_BIT(wheel));
    PWM_DUTY(wheel) = duty < 0 ? -duty : duty;
}
