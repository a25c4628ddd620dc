/* Pins and interrupts of the two boards: Arduino Uno or Nano (ATmega328P), and Mega 2560.
 *
 * PWM comes from timers 0 and 2, which both chips have, and for wheel d of the Mega from timer 3:
 * timer 0's other pin is 13 there, which the boot loader drives and blinks at every reset. Timer 1
 * runs the loop. Encoders stand on pins that can interrupt when they change: bits 2n and 2n + 1 of
 * a port are A and B of a wheel.
 */
#ifndef BOARD_H
#define BOARD_H

#include <avr/interrupt.h>
#include <avr/io.h>

#define WHEELS 4

#if defined(__AVR_ATmega328P__)

/* Wheel:           a        b         c        d
 * PWM:             3 (PD3)  11 (PB3)  5 (PD5)  6 (PD6)
 * direction:       2 (PD2)  12 (PB4)  4 (PD4)  7 (PD7)
 * encoder A:       A0 (PC0) A2 (PC2)  A4 (PC4) 8 (PB0)
 * encoder B:       A1 (PC1) A3 (PC3)  A5 (PC5) 9 (PB1) */
#define MOTOR_PINS \
    { \
        {&OCR2B, &DDRD, 1 << PD3, &PORTD, &DDRD, 1 << PD2}, \
        {&OCR2A, &DDRB, 1 << PB3, &PORTB, &DDRB, 1 << PB4}, \
        {&OCR0B, &DDRD, 1 << PD5, &PORTD, &DDRD, 1 << PD4}, \
        {&OCR0A, &DDRD, 1 << PD6, &PORTD, &DDRD, 1 << PD7}, \
    }
#define UART_RECEIVED_vect USART_RX_vect
#define UART_EMPTY_vect USART_UDRE_vect

#elif defined(__AVR_ATmega2560__)

/* Wheel:           a         b         c         d
 * PWM:             9 (PH6)   10 (PB4)  4 (PG5)   5 (PE3)
 * direction:       22 (PA0)  23 (PA1)  24 (PA2)  25 (PA3)
 * encoder A:       A8 (PK0)  A10 (PK2) A12 (PK4) A14 (PK6)
 * encoder B:       A9 (PK1)  A11 (PK3) A13 (PK5) A15 (PK7) */
#define MOTOR_PINS \
    { \
        {&OCR2B, &DDRH, 1 << PH6, &PORTA, &DDRA, 1 << PA0}, \
        {&OCR2A, &DDRB, 1 << PB4, &PORTA, &DDRA, 1 << PA1}, \
        {&OCR0B, &DDRG, 1 << PG5, &PORTA, &DDRA, 1 << PA2}, \
        {&OCR3AL, &DDRE, 1 << PE3, &PORTA, &DDRA, 1 << PA3}, \
    }
#define UART_RECEIVED_vect USART0_RX_vect
#define UART_EMPTY_vect USART0_UDRE_vect

#else
#error "This program is for the ATmega328P and the ATmega2560: choose that board."
#endif

#endif
