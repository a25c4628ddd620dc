/* Quadrature encoders: every edge of both channels counts. */
#ifndef ENCODERS_H
#define ENCODERS_H

#include "board.h"

void encoders_begin(void);

/* Read the four counts; they wrap at 16 bits. */
void encoders_read(uint16_t counts[WHEELS]);

#endif
