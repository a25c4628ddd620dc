#include "motors.h"

#include "config.h"

/* Where a motor is connected. */
struct pins {
    volatile uint8_t *duty; /* output compare register of its PWM */
    volatile uint8_t *pwm_ddr;
    uint8_t pwm_mask;
    volatile uint8_t *direction_port;
    volatile uint8_t *direction_ddr;
    uint8_t direction_mask;
};

static const struct pins motors[WHEELS] = MOTOR_PINS;
static const uint8_t reversed[WHEELS] = MOTOR_REVERSED;

void motors_begin(void)
{
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++) {
        const struct pins *motor = &motors[wheel];
        *motor->duty = 0;
        *motor->pwm_ddr |= motor->pwm_mask;
        *motor->direction_ddr |= motor->direction_mask;
    }
    /* Phase-correct PWM at 3.9 kHz: a duty of 0 is no pulse at all. */
#if defined(__AVR_ATmega2560__)
    TCCR0A = 1 << COM0B1 | 1 << WGM00;
    TCCR3A = 1 << COM3A1 | 1 << WGM30; /* 8 bits, as the others */
    TCCR3B = 1 << CS31;
#else
    TCCR0A = 1 << COM0A1 | 1 << COM0B1 | 1 << WGM00;
#endif
    TCCR0B = 1 << CS01;
    TCCR2A = 1 << COM2A1 | 1 << COM2B1 | 1 << WGM20;
    TCCR2B = 1 << CS21;
}

void motors_set(uint8_t wheel, int16_t duty)
{
    const struct pins *motor = &motors[wheel];
    uint8_t backward = (duty < 0) != reversed[wheel];
    if (backward)
        *motor->direction_port |= motor->direction_mask;
    else
        *motor->direction_port &= ~motor->direction_mask;
    *motor->duty = duty < 0 ? -duty : duty;
}
