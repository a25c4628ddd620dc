/* Pins and interrupts of the two boards: Arduino Uno or Nano (ATmega328P), and Mega 2560.
 *
 * PWM comes from timers 0 and 2, which both chips have; timer 1 runs the loop. Encoders stand on
 * pins that can interrupt when they change: bits 2n and 2n + 1 of a port are A and B of a wheel.
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
#define PWM_DDR(wheel) (*(volatile uint8_t *const[]){&DDRD, &DDRB, &DDRD, &DDRD}[wheel])
#define PWM_BIT(wheel) ((const uint8_t[]){PD3, PB3, PD5, PD6}[wheel])
#define DIRECTION_DDR(wheel) (*(volatile uint8_t *const[]){&DDRD, &DDRB, &DDRD, &DDRD}[wheel])
#define DIRECTION_PORT(wheel) (*(volatile uint8_t *const[]){&PORTD, &PORTB, &PORTD, &PORTD}[wheel])
#define DIRECTION_BIT(wheel) ((const uint8_t[]){PD2, PB4, PD4, PD7}[wheel])
#define UART_RECEIVED_vect USART_RX_vect
#define UART_EMPTY_vect USART_UDRE_vect

#elif defined(__AVR_ATmega2560__)

/* Wheel:           a         b         c         d
 * PWM:             9 (PH6)   10 (PB4)  4 (PG5)   13 (PB7)
 * direction:       22 (PA0)  23 (PA1)  24 (PA2)  25 (PA3)
 * encoder A:       A8 (PK0)  A10 (PK2) A12 (PK4) A14 (PK6)
 * encoder B:       A9 (PK1)  A11 (PK3) A13 (PK5) A15 (PK7) */
#define PWM_DDR(wheel) (*(volatile uint8_t *const[]){&DDRH, &DDRB, &DDRG, &DDRB}[wheel])
#define PWM_BIT(wheel) ((const uint8_t[]){PH6, PB4, PG5, PB7}[wheel])
#define DIRECTION_DDR(wheel) DDRA
#define DIRECTION_PORT(wheel) PORTA
#define DIRECTION_BIT(wheel) (wheel)
#define UART_RECEIVED_vect USART0_RX_vect
#define UART_EMPTY_vect USART0_UDRE_vect

#else
#error "This program is for the ATmega328P and the ATmega2560: choose that board."
#endif

/* Output compare registers of the PWM pins above, the same on both boards. */
#define PWM_DUTY(wheel) (*(volatile uint8_t *const[]){&OCR2B, &OCR2A, &OCR0B, &OCR0A}[wheel])

#endif
