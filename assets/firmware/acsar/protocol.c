#include "protocol.h"

#define PART 7   /* length of a part: ap12.50 */
#define BAD 255  /* place in a part that has had a wrong byte */

/* Whether a byte may stand at the parser's place; takes its meaning if so. */
static uint8_t fits(struct parser *parser, uint8_t byte)
{
    switch (parser->place) {
    case 0:
        parser->motor = byte - 'a';
        parser->value = 0;
        return parser->motor < MOTORS;
    case 1:
        parser->backward = byte == 'n';
        return byte == 'p' || byte == 'n';
    case 4:
        return byte == '.';
    case 2: case 3: case 5: case 6:
        if (byte < '0' || byte > '9')
            return 0;
        parser->value = parser->value * 10 + (byte - '0');
        return 1;
    default: /* after a whole part, or after a wrong byte */
        return 0;
    }
}

/* A part has ended: keep it if it is whole. */
static void end_part(struct parser *parser)
{
    if (parser->place == PART) {
        parser->speeds[parser->motor] = parser->backward ? -parser->value : parser->value;
        parser->named |= 1 << parser->motor;
    }
    parser->place = 0;
}

/* A line has ended: hand over what it named. */
static uint8_t end_line(struct parser *parser, int16_t speeds[MOTORS])
{
    uint8_t named = parser->length > LONGEST_LINE ? 0 : parser->named;
    for (uint8_t motor = 0; motor < MOTORS; motor++)
        if (named & (1 << motor))
            speeds[motor] = parser->speeds[motor];
    parser->named = 0;
    parser->length = 0;
    return named;
}

uint8_t protocol_take(struct parser *parser, uint8_t byte, int16_t speeds[MOTORS])
{
    if (byte == '\r' || byte == '\n') {
        end_part(parser);
        return end_line(parser, speeds);
    }
    if (parser->length <= LONGEST_LINE)
        parser->length++;
    if (byte == ',')
        end_part(parser);
    else
        parser->place = fits(parser, byte) ? parser->place + 1 : BAD;
    return 0;
}

uint8_t protocol_line(const int16_t speeds[MOTORS], uint8_t trailing_comma, char line[LINE_BYTES])
{
    char *end = line;
    for (uint8_t motor = 0; motor < MOTORS; motor++) {
        int16_t speed = speeds[motor];
        uint16_t size = speed < 0 ? -speed : speed;
        if (size > MOST_SPEED)
            size = MOST_SPEED;
        if (motor > 0)
            *end++ = ',';
        *end++ = 'a' + motor;
        *end++ = speed < 0 ? 'n' : 'p';
        *end++ = '0' + size / 1000;
        *end++ = '0' + size / 100 % 10;
        *end++ = '.';
        *end++ = '0' + size / 10 % 10;
        *end++ = '0' + size % 10;
    }
    if (trailing_comma)
        *end++ = ',';
    *end++ = '\r';
    *end++ = '\n';
    return end - line;
}
