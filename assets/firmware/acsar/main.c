/* Program of the ACSAR robot's board: speeds of four wheels in, measured speeds out.
 *
 * Interrupts count the encoders' edges, move bytes, and count loops. Everything else is here: one
 * loop takes received bytes as they come, and LOOP_RATE times a second runs the speed loops.
 */
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <string.h>
#include <util/atomic.h>

#include "board.h"
#include "config.h"
#include "encoders.h"
#include "motors.h"
#include "protocol.h"
#include "speed.h"
#include "uart.h"

#define LOOPS_PER_LINE (LOOP_RATE / FEEDBACK_RATE)
#define TIMEOUT_LOOPS ((uint16_t)((uint32_t)COMMAND_TIMEOUT_MS * LOOP_RATE / 1000))
#define TIMER_STEPS (F_CPU / 8 / LOOP_RATE)

_Static_assert(TIMER_STEPS * LOOP_RATE * 8 == F_CPU && TIMER_STEPS <= 65536,
               "LOOP_RATE: must divide the clock by a multiple of 8, up to 524,288");
_Static_assert(BAUD_RATE / 10 / LINE_BYTES >= FEEDBACK_RATE,
               "FEEDBACK_RATE: more lines than BAUD_RATE can carry");
_Static_assert((uint32_t)COMMAND_TIMEOUT_MS * LOOP_RATE / 1000 < 65536,
               "COMMAND_TIMEOUT_MS: must be less than 65536 loops");

static volatile uint8_t loops_due;
static struct wheel wheels[WHEELS];
static struct parser parser;
static uint16_t silence = TIMEOUT_LOOPS; /* loops since the last valid command */

ISR(TIMER1_COMPA_vect)
{
    loops_due++;
}

static void begin_loops(void)
{
    OCR1A = TIMER_STEPS - 1;
    TCCR1B = 1 << WGM12 | 1 << CS11;
    TIMSK1 = 1 << OCIE1A;
}

/* Take one received byte; set the targets at the end of a line. */
static void receive(uint8_t byte)
{
    int16_t speeds[MOTORS];
    uint8_t named = protocol_take(&parser, byte, speeds);
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++)
        if (named & (1 << wheel))
            speed_command(&wheels[wheel], speeds[wheel]);
    if (named)
        silence = 0;
}

/* Send the wheels' speeds, averaged over the last WINDOW_LINES lines. */
static void answer(const uint16_t counts[WHEELS])
{
    static uint16_t before[WINDOW_LINES][WHEELS];
    static uint8_t oldest;
    int16_t speeds[WHEELS];
    char line[LINE_BYTES];
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++) {
        speeds[wheel] = speed_of(counts[wheel] - before[oldest][wheel]);
        before[oldest][wheel] = counts[wheel];
    }
    oldest = (oldest + 1) % WINDOW_LINES;
    uart_send(line, protocol_line(speeds, TRAILING_COMMA, line));
}

/* Say why a motor is cut, in a line of text: when that begins, and then once a second. */
static void report(uint8_t wheel)
{
    static const char *const reasons[] = {
        [CUT_CONTRARY] = "turns against its motor\r\n",
        [CUT_STALLED] = "stalled, or no encoder\r\n",
    };
    static uint8_t said[WHEELS];
    static uint16_t lines[WHEELS];
    char line[40] = "# a cut: ";
    uint8_t cut = wheels[wheel].guard.cut;
    if (cut == said[wheel] && ++lines[wheel] < FEEDBACK_RATE)
        return;
    said[wheel] = cut;
    lines[wheel] = 0;
    if (cut == NOT_CUT)
        return;
    line[2] += wheel;
    strcat(line, reasons[cut]);
    uart_send(line, strlen(line));
}

/* Run one loop: measure, answer when it is time, and set the motors. */
static void loop(void)
{
    static uint8_t loops;
    uint16_t counts[WHEELS];
    encoders_read(counts);
    if (++loops == LOOPS_PER_LINE) {
        loops = 0;
        answer(counts);
        for (uint8_t wheel = 0; wheel < WHEELS; wheel++)
            report(wheel);
    }
    uint8_t silent = silence >= TIMEOUT_LOOPS;
    if (!silent)
        silence++;
    for (uint8_t wheel = 0; wheel < WHEELS; wheel++) {
        if (silent)
            speed_command(&wheels[wheel], 0);
        motors_set(wheel, speed_step(&wheels[wheel], counts[wheel]));
    }
}

/* Whether there is something to do; sleeps until the next interrupt if not. */
static uint8_t is_due(void)
{
    cli();
    if (loops_due == 0 && !uart_waiting()) {
        sleep_enable();
        sei(); /* takes effect after the next instruction: no interrupt is slept through */
        sleep_cpu();
        sleep_disable();
        return 0;
    }
    sei();
    return 1;
}

#if WATCHDOG
/* After a reset by the watchdog it still runs, with 16 ms, and must be stopped at once. */
void stop_watchdog(void) __attribute__((naked, used, section(".init3")));
void stop_watchdog(void)
{
    MCUSR = 0;
    wdt_disable();
}
#endif

int main(void)
{
    motors_begin();
    encoders_begin();
    uart_begin();
    begin_loops();
#if WATCHDOG
    wdt_enable(WDTO_120MS);
#endif
    sei();
    for (;;) {
        uint8_t byte;
        if (!is_due())
            continue;
        while (uart_take(&byte))
            receive(byte);
        if (loops_due == 0)
            continue;
        ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
        {
            loops_due--;
        }
        loop();
        wdt_reset();
    }
}
