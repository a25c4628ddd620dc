#include "chip.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <simavr/avr_extint.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <simavr/sim_interrupts.h>
#include <simavr/sim_time.h>

#define QUEUE 65536 /* bytes */
#define LONGEST_SLEEP 160 /* cycles */
#define BYTE_CYCLES (CLOCK * 10.0 / 115200.0)
#define BYTES_END 86.8e-6 /* time that a byte takes on the wire [s] */

/* Registers in the data space, the same on both chips. */
enum { TCCR0A = 0x44, TCCR0B = 0x45, OCR0A = 0x47, OCR0B = 0x48 };
enum { TCCR2A = 0xB0, TCCR2B = 0xB1, OCR2A = 0xB3, OCR2B = 0xB4, TIMSK1 = 0x6F };
enum { TCCR3A = 0x90, TCCR3B = 0x91, OCR3AL = 0x98 }; /* of the ATmega2560 alone */
enum { PCIFR = 0x3B, PCICR = 0x68, PCMSK2 = 0x6D };

struct pin {
    char port;
    uint8_t bit;
};

struct board {
    const char *name;
    struct pin pwm[WHEELS], direction[WHEELS], a[WHEELS], b[WHEELS];
};

static const struct board boards[] = {
    {"atmega328p",
     {{'D', 3}, {'B', 3}, {'D', 5}, {'D', 6}},
     {{'D', 2}, {'B', 4}, {'D', 4}, {'D', 7}},
     {{'C', 0}, {'C', 2}, {'C', 4}, {'B', 0}},
     {{'C', 1}, {'C', 3}, {'C', 5}, {'B', 1}}},
    {"atmega2560",
     {{'H', 6}, {'B', 4}, {'G', 5}, {'E', 3}},
     {{'A', 0}, {'A', 1}, {'A', 2}, {'A', 3}},
     {{'K', 0}, {'K', 2}, {'K', 4}, {'K', 6}},
     {{'K', 1}, {'K', 3}, {'K', 5}, {'K', 7}}},
};

struct chip {
    avr_t *avr;
    const struct board *board;
    avr_irq_t *input;
    uint8_t received[QUEUE], sent[QUEUE];
    size_t received_in, received_out, sent_in, sent_out;
    double next_byte; /* cycle at which the next received byte may start */
    int full;         /* simavr's own queue of received bytes is */
    double ended[QUEUE];
    avr_ioport_external_t driven['L' - 'A' + 1];
    int64_t count[WHEELS];
    int resets;
    int deepest;
    avr_cycle_count_t end; /* of the run */
    uint64_t slept;
};

static struct chip the_chip;

/* Pin changes of the ATmega2560's port K, which simavr 1.6 doesn't know. */
static avr_int_vector_t port_k = {
    .vector = 11,
    .enable = {.reg = PCICR, .bit = 2, .mask = 1},
    .raised = {.reg = PCIFR, .bit = 2, .mask = 1},
};

static void fail(const char *what, const char *which)
{
    fprintf(stderr, "avr_board: %s: %s\n", which, what);
    exit(2);
}

static void on_sent(avr_irq_t *irq, uint32_t value, void *param)
{
    struct chip *chip = param;
    chip->ended[chip->sent_in] = (double)chip->avr->cycle / CLOCK + BYTES_END;
    chip->sent[chip->sent_in] = value;
    chip->sent_in = (chip->sent_in + 1) % QUEUE;
}

static void on_full(avr_irq_t *irq, uint32_t value, void *param)
{
    ((struct chip *)param)->full = 1;
}

static void on_room(avr_irq_t *irq, uint32_t value, void *param)
{
    ((struct chip *)param)->full = 0;
}

static void on_sleep(avr_t *avr, avr_cycle_count_t cycles)
{
    the_chip.slept += cycles + 1;
}

/* End a sleep at least so often, and where a run ends, so that edges come when they should; a reset
 * of the chip forgets it, so each run begins it anew. */
static avr_cycle_count_t wake(avr_t *avr, avr_cycle_count_t when, void *param)
{
    avr_cycle_count_t end = ((struct chip *)param)->end, next = when + LONGEST_SLEEP;
    return when < end && next > end ? end : next;
}

static void quiet(avr_t *avr, const int level, const char *format, va_list arguments)
{
    if (level <= LOG_ERROR)
        vfprintf(stderr, format, arguments);
}

/* Drive an input. Without "external", simavr pulls it up again at each write of its port. */
static void set_pin(struct chip *chip, struct pin pin, int level)
{
    avr_ioport_external_t *driven = &chip->driven[pin.port - 'A'];
    driven->name = pin.port;
    driven->mask |= 1 << pin.bit;
    driven->value = (driven->value & ~(1 << pin.bit)) | level << pin.bit;
    avr_ioctl(chip->avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(pin.port), driven);
    avr_irq_t *irq = avr_io_getirq(chip->avr, AVR_IOCTL_IOPORT_GETIRQ(pin.port), pin.bit);
    int changed = irq->value != (uint32_t)level;
    avr_raise_irq(irq, level);
    if (pin.port == 'K' && changed && chip->avr->data[PCMSK2] >> pin.bit & 1)
        avr_raise_interrupt(chip->avr, &port_k);
}

static void set_encoder(struct chip *chip, int wheel)
{
    int phase = chip->count[wheel] & 3; /* A, B: 00 10 11 01 */
    set_pin(chip, chip->board->a[wheel], phase == 1 || phase == 2);
    set_pin(chip, chip->board->b[wheel], phase == 2 || phase == 3);
}

static void connect_uart(struct chip *chip)
{
    uint32_t flags = 0;
    avr_ioctl(chip->avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *uart = avr_io_getirq(chip->avr, AVR_IOCTL_UART_GETIRQ('0'), 0);
    chip->input = uart + UART_IRQ_INPUT;
    avr_irq_register_notify(uart + UART_IRQ_OUTPUT, on_sent, chip);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XON, on_room, chip);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XOFF, on_full, chip);
}

/* Switch off what takes simavr long and isn't used: polling of external interrupts by level, and
 * timers 0 and 2 (and 3), whose phase-correct PWM it doesn't know: what their pins do is computed
 * from their registers. */
static void be_quick(avr_t *avr)
{
    for (int number = 0; number < 2; number++)
        avr_extint_set_strict_lvl_trig(avr, number, 0);
    const int registers[] = {TCCR0A, TCCR0B, OCR0A,  OCR0B,  TCCR2A, TCCR2B,
                             OCR2A,  OCR2B,  TCCR3A, TCCR3B, OCR3AL};
    for (size_t i = 0; i < sizeof registers / sizeof *registers; i++)
        avr->io[AVR_DATA_TO_IO(registers[i])].w.c = NULL;
}

struct chip *chip_new(const char *name, const char *elf)
{
    struct chip *chip = &the_chip;
    elf_firmware_t program = {0};
    avr_global_logger_set(quiet);
    for (size_t i = 0; i < sizeof boards / sizeof *boards; i++)
        if (strcmp(name, boards[i].name) == 0)
            chip->board = &boards[i];
    if (!chip->board || !(chip->avr = avr_make_mcu_by_name(name)))
        fail("unknown chip: atmega328p or atmega2560", name);
    if (elf_read_firmware(elf, &program))
        fail("can't be read as a program", elf);
    avr_init(chip->avr);
    chip->avr->frequency = CLOCK;
    avr_load_firmware(chip->avr, &program);
    if (strcmp(name, "atmega2560") == 0)
        avr_register_vector(chip->avr, &port_k);
    chip->avr->sleep = on_sleep;
    chip->deepest = chip->avr->ramend;
    be_quick(chip->avr);
    connect_uart(chip);
    for (int wheel = 0; wheel < WHEELS; wheel++)
        set_encoder(chip, wheel);
    return chip;
}

static void feed(struct chip *chip)
{
    double now = chip->avr->cycle;
    if (chip->next_byte < now - BYTE_CYCLES)
        chip->next_byte = now - BYTE_CYCLES;
    while (!chip->full && chip->received_out != chip->received_in && chip->next_byte <= now) {
        avr_raise_irq(chip->input, chip->received[chip->received_out]);
        chip->received_out = (chip->received_out + 1) % QUEUE;
        chip->next_byte += BYTE_CYCLES;
    }
}

void chip_run(struct chip *chip, double time)
{
    avr_t *avr = chip->avr;
    avr_cycle_count_t end = chip->end = time * CLOCK;
    feed(chip);
    if (avr->cycle >= end)
        return;
    avr_cycle_count_t left = end - avr->cycle;
    avr_cycle_timer_register(avr, left < LONGEST_SLEEP ? left : LONGEST_SLEEP, wake, chip);
    while (avr->cycle < end) {
        int state = avr_run(avr);
        if (state == cpu_Done || state == cpu_Crashed)
            fail("the program crashed", chip->board->name);
        int stack = avr->data[R_SPL] | avr->data[R_SPH] << 8;
        if (stack && stack < chip->deepest)
            chip->deepest = stack;
        chip->resets += avr->pc == 0;
    }
}

/* Duty of an output compare register in phase-correct PWM; 0 if the timer isn't set up for it. */
static double duty_of(const struct chip *chip, int mode, int output, int compare)
{
    const uint8_t *data = chip->avr->data;
    int runs = (data[mode] & 3) == 1 && (data[mode + 1] & 7) && (data[mode] >> output & 3) == 2;
    return runs ? data[compare] / 255.0 : 0.0;
}

/* Address of a port's PIN register; DDR and PORT follow it. */
static int port_at(char port)
{
    return port < 'H' ? 0x20 + 3 * (port - 'A') : 0x100 + 3 * (port - 'H' - (port > 'H'));
}

static int is_output(const struct chip *chip, struct pin pin)
{
    return chip->avr->data[port_at(pin.port) + 1] >> pin.bit & 1;
}

static int is_high(const struct chip *chip, struct pin pin)
{
    return chip->avr->data[port_at(pin.port) + 2] >> pin.bit & 1;
}

void chip_duties(const struct chip *chip, double duty[WHEELS])
{
    duty[0] = duty_of(chip, TCCR2A, 4, OCR2B);
    duty[1] = duty_of(chip, TCCR2A, 6, OCR2A);
    duty[2] = duty_of(chip, TCCR0A, 4, OCR0B);
    duty[3] = chip->board->pwm[3].port == 'E' ? duty_of(chip, TCCR3A, 6, OCR3AL)
                                              : duty_of(chip, TCCR0A, 6, OCR0A);
    for (int wheel = 0; wheel < WHEELS; wheel++) {
        struct pin pwm = chip->board->pwm[wheel], direction = chip->board->direction[wheel];
        if (!is_output(chip, pwm) || !is_output(chip, direction))
            duty[wheel] = 0.0;
        else if (is_high(chip, direction))
            duty[wheel] = -duty[wheel];
    }
}

void chip_turn(struct chip *chip, int wheel, int64_t count)
{
    while (chip->count[wheel] != count) {
        chip->count[wheel] += chip->count[wheel] < count ? 1 : -1;
        set_encoder(chip, wheel);
    }
}

void chip_receive(struct chip *chip, const uint8_t *bytes, size_t length)
{
    for (size_t i = 0; i < length; i++) {
        chip->received[chip->received_in] = bytes[i];
        chip->received_in = (chip->received_in + 1) % QUEUE;
    }
}

size_t chip_sent(struct chip *chip, uint8_t *bytes, size_t room, double *ended)
{
    size_t length = 0;
    double now = (double)chip->avr->cycle / CLOCK;
    while (chip->sent_out != chip->sent_in && chip->ended[chip->sent_out] <= now && length < room) {
        *ended = chip->ended[chip->sent_out];
        bytes[length++] = chip->sent[chip->sent_out];
        chip->sent_out = (chip->sent_out + 1) % QUEUE;
    }
    return length;
}

void chip_hang(struct chip *chip)
{
    chip->avr->data[TIMSK1] = 0;
}

int chip_resets(const struct chip *chip)
{
    return chip->resets;
}

int chip_stack(const struct chip *chip)
{
    return chip->avr->ramend - chip->deepest;
}

double chip_busy(const struct chip *chip)
{
    return 1.0 - (double)chip->slept / chip->avr->cycle;
}
