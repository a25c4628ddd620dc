/* The simulated microcontroller with its program: pins of motors and encoders, and bytes. */
#ifndef CHIP_H
#define CHIP_H

#include <stddef.h>
#include <stdint.h>

#include "wheels.h"

#define CLOCK 16000000

struct chip;

/* Load a program; `name` is atmega328p or atmega2560. Exits with a message if that fails. */
struct chip *chip_new(const char *name, const char *elf);

/* Run to a time [s] after power-up. */
void chip_run(struct chip *chip, double time);

/* Read what the pins make of the motors: duties of -1 to 1, 0 for a pin that isn't driven. */
void chip_duties(const struct chip *chip, double duty[WHEELS]);

/* Turn an encoder by single edges to this count. */
void chip_turn(struct chip *chip, int wheel, int64_t count);

/* Queue bytes for its UART, which takes them one after the other at its baud rate. */
void chip_receive(struct chip *chip, const uint8_t *bytes, size_t length);

/* Take the bytes that it has sent, with the time [s] at which the last one ended. */
size_t chip_sent(struct chip *chip, uint8_t *bytes, size_t room, double *ended);

/* Stop its loop's timer, as a program that hangs. */
void chip_hang(struct chip *chip);

/* Figures since power-up: resets, deepest stack [bytes], share of time in which it didn't sleep. */
int chip_resets(const struct chip *chip);
int chip_stack(const struct chip *chip);
double chip_busy(const struct chip *chip);

#endif
