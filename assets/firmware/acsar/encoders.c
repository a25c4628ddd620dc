#include "encoders.h"

#include <util/atomic.h>

#include "config.h"

/* Each edge is an interrupt of 5 us. With all four wheels at this rate and commands filling the line,
 * the chip is busy for nine tenths of the time; a quarter more, and loops come late. */
#define MOST_EDGES 16000 /* of a wheel [1/s] */

_Static_assert((int32_t)(FULL_SPEED * COUNTS_PER_TURN / 6.283185307179586) <= MOST_EDGES,
               "COUNTS_PER_TURN: more than the 16000 edges/s of a wheel that the chip counts, at "
               "FULL_SPEED: set what your motors reach, or count one channel, ENCODER_CHANNELS 1");
_Static_assert(ENCODER_CHANNELS == 1 || ENCODER_CHANNELS == 2,
               "ENCODER_CHANNELS: 2 counts every edge of A and B, 1 those of A");

static volatile uint16_t wheels[WHEELS];

/* One bit for each wheel, the one of its channel A in the port: whether one edge has passed, and
 * whether it was a forward one. If both channels changed at once, an edge was missed, and the
 * direction isn't known. */
#if ENCODER_CHANNELS == 2
#define EDGES(before, now) (((before) ^ (now)) ^ ((before) ^ (now)) >> 1)
#define FORWARD(before, now) ((before) >> 1 ^ (now))
#define PINS(mask) (mask)
#else
#define EDGES(before, now) ((before) ^ (now))
#define FORWARD(before, now) ((now) >> 1 ^ (now))
#define PINS(mask) ((mask) & 0x55)
#endif

/* Count for one wheel; `bit` is its channel A. */
static inline __attribute__((always_inline)) void count(uint8_t wheel, uint8_t bit, uint8_t edges,
                                                        uint8_t forward)
{
    if (!(edges & (1 << bit)))
        return;
    if (forward & (1 << bit))
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
    PCMSK1 = PINS(0x3F);
    PCMSK0 = PINS(0x03);
    PCICR = 1 << PCIE1 | 1 << PCIE0;
}

ISR(PCINT1_vect)
{
    uint8_t now = PINC, before = before_abc;
    uint8_t edges = EDGES(before, now), forward = FORWARD(before, now);
    before_abc = now;
    count(0, 0, edges, forward);
    count(1, 2, edges, forward);
    count(2, 4, edges, forward);
}

ISR(PCINT0_vect)
{
    uint8_t now = PINB, before = before_d;
    before_d = now;
    count(3, 0, EDGES(before, now), FORWARD(before, now));
}

#else

static uint8_t before_all;

void encoders_begin(void)
{
    PORTK = 0xFF; /* pull-ups, for open collectors and missing cables */
    before_all = PINK;
    PCMSK2 = PINS(0xFF);
    PCICR = 1 << PCIE2;
}

ISR(PCINT2_vect)
{
    uint8_t now = PINK, before = before_all;
    uint8_t edges = EDGES(before, now), forward = FORWARD(before, now);
    before_all = now;
    count(0, 0, edges, forward);
    count(1, 2, edges, forward);
    count(2, 4, edges, forward);
    count(3, 6, edges, forward);
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
