/* What fits your robot: change it here. Pins are in board.h.
 *
 * assets/robots/acsar_avr.yaml has the same numbers, for the simulation. Numbers with a point are
 * used by the compiler alone: the program has no floating point.
 */
#ifndef CONFIG_H
#define CONFIG_H

/* The serial line. */
#define BAUD_RATE 115200UL     /* [bit/s], 8N1 */
#define FEEDBACK_RATE 100      /* encoder lines per second [Hz]; LOOP_RATE is a multiple of it */
#define TRAILING_COMMA 0       /* 1: feedback lines have a comma before their end */
#define COMMAND_TIMEOUT_MS 500 /* the motors stop after this time without a valid command [ms] */

/* The wheels, in the order a, b, c, d: front right, front left, rear left, rear right. */
#define COUNTS_PER_TURN 1320         /* of a wheel: four times pulses per turn, times the gears */
#define ENCODER_CHANNELS 2           /* 1: count channel A alone; COUNTS_PER_TURN is then half */
#define MOTOR_REVERSED {0, 0, 0, 0}  /* 1: this motor turns backward with its cables as they are */
#define ENCODER_REVERSED {0, 0, 0, 0} /* 1: this encoder counts backward */

/* The speed loops. */
#define LOOP_RATE 1000       /* [Hz] */
#define WINDOW_LINES 5       /* feedback is averaged over so many of its periods */
#define MAX_SPEED 30.0       /* largest wheel speed; faster commands are cut down to it [rad/s] */
#define ACCELERATION 60.0    /* of the set points' ramp [rad/s^2] */
#define TIME_CONSTANT 0.08   /* of the motors with the robot's weight on them [s] */
#define FULL_SPEED 36.0      /* wheel speed with full PWM and charged batteries [rad/s] */
#define SPEED_GAIN 1.0       /* of a speed error [rad/s per rad/s] */
#define ANGLE_GAIN 12.5      /* of the summed up speed error [rad/s per rad] */
#define CORRECTION_SHARE 0.4 /* the two gains above use at most this share of full PWM */
#define STALL_MS 1000        /* a motor that pulls that hard without an edge for so long is cut [ms] */

/* The chip's watchdog resets it if the loop hangs. 0 turns it off, for old Mega 2560 boot loaders
 * and old Nanos that never come back from such a reset. */
#define WATCHDOG 1

#endif
