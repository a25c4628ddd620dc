#include "encoders.h"

#include <util/atomic.h>

#include "config.h"

static volatile uint16_t wheels[WHEELS];

/* Count a change of one wheel's two bits in a port; if both changed at once, an edge was missed,
 * and the direction isn't known. */
static inline __attribute__((always_inline)) void count(uint8_t wheel, uint8_t bit, uint8_t before,
                                                        uint8_t now)
{
    uint8_t changed = (before ^ now) >> bit & 3;
    if (changed == 0 || changed == 3)
        return;
    if ((before >> (bit + 1) ^ now >> bit) & 1)
        wheels[wheel]++;
    else
        wheels[wheel]--;
}

#if defined(__AVR_ATmega328P__)

static uint8_t before_abc, before_d;

void encoders_begin(void)
{
    PORTC |= 0x3F; /* pull-ups, for open collectors and missing cables */
    PORTB |= 0x03;
    before_abc = PINC;
    before_d = PINB;
    PCMSK1 = 0x3F;
    PCMSK0 = 0x03;
    PCICR = 1 << PCIE1 | 1 << PCIE0;
}

ISR(PCINT1_vect)
{
    uint8_t now = PINC, before = before_abc;
    before_abc = now;
    count(0, 0, before, now);
    count(1, 2, before, now);
    count(2, 4, before, now);
}

ISR(PCINT0_vect)
{
    uint8_t now = PINB, before = before_d;
    before_d = now;
    count(3, 0, before, now);
}

#else

static uint8_t before_all;

void encoders_begin(void)
{
    PORTK = 0xFF; /* pull-ups, for open collectors and missing cables */
    before_all = PINK;
    PCMSK2 = 0xFF;
    PCICR = 1 << PCIE2;
}

ISR(PCINT2_vect)
{
    uint8_t now = PINK, before = before_all;
    before_all = now;
    count(0, 0, before, now);
    count(1, 2, before, now);
    count(2, 4, before, now);
    count(3, 6, before, now);
}

#endif

void encoders_read(uint16_t counts[WHEELS])
{
    static const uint8_t reversed[WHEELS] = ENCODER_REVERSED;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        for (uint8_t wheel = 0; wheel < WHEELS; wheel++)
            counts[wheel] = wheels[wheel];
    }
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++)
        if (reversed[wheel])
            counts[wheel] = -counts[wheel];
}
