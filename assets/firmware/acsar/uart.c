#include "uart.h"

#include "board.h"
#include "config.h"

#define RECEIVED 64 /* bytes, a power of two: 5 ms at 115200 baud */
#define SENT 128    /* bytes, a power of two: three lines */

#define DIVIDER ((F_CPU + 4 * BAUD_RATE) / (8 * BAUD_RATE) - 1)
#define REAL_RATE (F_CPU / (8 * (DIVIDER + 1)))

_Static_assert(REAL_RATE * 40 > BAUD_RATE * 39 && REAL_RATE * 40 < BAUD_RATE * 41,
               "BAUD_RATE: this clock makes none within 2.5 % of it");

static volatile uint8_t received[RECEIVED];
static volatile uint8_t received_in, received_out;
static volatile uint8_t damaged; /* bytes were lost: the next one isn't what follows the last */
static volatile char sent[SENT];
static volatile uint8_t sent_in, sent_out;

void uart_begin(void)
{
    UCSR0A = 1 << U2X0;
    UBRR0 = DIVIDER;
    UCSR0C = 1 << UCSZ01 | 1 << UCSZ00;
    UCSR0B = 1 << RXEN0 | 1 << TXEN0 | 1 << RXCIE0;
}

ISR(UART_RECEIVED_vect)
{
    uint8_t wrong = UCSR0A & (1 << FE0 | 1 << DOR0 | 1 << UPE0);
    uint8_t byte = UDR0;
    uint8_t next = (received_in + 1) % RECEIVED;
    if (next == received_out) {
        damaged = 1;
        return;
    }
    received[received_in] = wrong || damaged ? 0 : byte;
    damaged = 0;
    received_in = next;
}

uint8_t uart_waiting(void)
{
    return received_in != received_out;
}

uint8_t uart_take(uint8_t *byte)
{
    if (!uart_waiting())
        return 0;
    *byte = received[received_out];
    received_out = (received_out + 1) % RECEIVED;
    return 1;
}

void uart_send(const char *line, uint8_t length)
{
    uint8_t room = (sent_out - sent_in - 1) % SENT;
    if (length > room)
        return;
    while (length--) {
        sent[sent_in] = *line++;
        sent_in = (sent_in + 1) % SENT;
    }
    UCSR0B |= 1 << UDRIE0;
}

ISR(UART_EMPTY_vect)
{
    if (sent_in == sent_out) {
        UCSR0B &= ~(1 << UDRIE0);
        return;
    }
    UDR0 = sent[sent_out];
    sent_out = (sent_out + 1) % SENT;
}
