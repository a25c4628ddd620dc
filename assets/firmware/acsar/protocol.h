/* The lines of the wire: `ap12.50,bn08.75,cp15.00,dn10.25` and CR LF, in both directions.
 *
 * a motor (a front right, b front left, c rear left, d rear right), a direction (p forward,
 * n backward), and a speed in rad/s with two digits and two decimals. Nothing in these two files
 * is of the chip, so that they can be tested on any computer.
 */
#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdint.h>

#define MOTORS 4
#define LONGEST_LINE 256  /* longer ones are skipped to their end */
#define LINE_BYTES 34     /* of a feedback line with a trailing comma and CR LF */
#define MOST_SPEED 9999   /* of the format [0.01 rad/s] */

struct parser {
    int16_t speeds[MOTORS]; /* of the line so far [0.01 rad/s] */
    uint8_t named;          /* one bit for each motor that has a valid part in this line */
    uint8_t place;          /* where in a part the next byte stands */
    uint8_t motor;
    uint8_t backward;
    int16_t value;
    uint16_t length;        /* of the line so far */
};

/* Take one byte. At a line's end, returns one bit for each motor that `speeds` has a new value of
 * [0.01 rad/s]; otherwise 0. Bad parts are skipped, and the line's others used. */
uint8_t protocol_take(struct parser *parser, uint8_t byte, int16_t speeds[MOTORS]);

/* Write the feedback line of four speeds [0.01 rad/s]; returns its length. */
uint8_t protocol_line(const int16_t speeds[MOTORS], uint8_t trailing_comma, char line[LINE_BYTES]);

#endif
