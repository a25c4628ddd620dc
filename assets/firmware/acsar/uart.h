/* The serial line, by interrupts: nothing here waits. */
#ifndef UART_H
#define UART_H

#include <stdint.h>

void uart_begin(void);

/* Take the oldest received byte; returns 0 if there is none. A byte that was damaged on the line
 * reads as NUL, which no valid part contains. */
uint8_t uart_take(uint8_t *byte);

/* Whether a byte waits; for use with interrupts off. */
uint8_t uart_waiting(void);

/* Send a line, or none of it if there isn't room for all. */
void uart_send(const char *line, uint8_t length);

#endif
