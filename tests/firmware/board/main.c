/* avr_board: the board's real program on a simulated chip, with motors and encoders.
 *
 *     avr_board CHIP ELF [--log FILE] [--name LINK] [--silent] [--gain A,B,C,D] [--lag A,B,C,D]
 *               [--way A,B,C,D] [--counts EDGES_PER_TURN] [--full SPEED]
 *     avr_board CHIP ELF --script [--log FILE] ... < SCRIPT
 *
 * The first form serves a pseudo-terminal in real time, as `acsar-gym emulate` does: it prints the
 * device, SIGUSR1 unplugs it and SIGUSR2 plugs it in again. The second runs a script as fast as it
 * can; its lines are TIME and `send HEX`, `hang`, `turn WHEEL SPEED` (0 blocks it), `free WHEEL`,
 * `load WHEEL SPEED` or `end`, with times in seconds after power-up and speeds in rad/s. The log
 * has the emulator's events, and more; its times are of the monotonic clock, or of the script;
 * "own" is the chip's, which on a busy computer stands still where "lost" tells of it.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <math.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "cable.h"
#include "chip.h"

#define SLICE 40e-6 /* of the wheels' simulation [s] */
#define FINE 2.5e-6 /* the same where edges come fast: those of two wheels seldom share one [s] */
#define TURN 1e-3   /* of the cable and of real time [s] */
#define NOTE 5e-3   /* of the log [s] */
#define STALL 0.1   /* a delay by the operating system is caught up with, unless longer [s] */

static volatile sig_atomic_t plugged = 1, ended;
static FILE *notes;
static int scripted, silent;
static struct chip *chip;
static struct wheels wheels = {.counts_per_turn = 1320,
                               .full_speed = 36.0,
                               .gain = {1, 1, 1, 1},
                               .time_constant = {.08, .08, .08, .08},
                               .way = {1, 1, 1, 1}};
static double now, slice = SLICE, duty[WHEELS];

static void on_signal(int number)
{
    if (number == SIGTERM || number == SIGINT)
        ended = 1;
    else
        plugged = number == SIGUSR2;
}

static double clock_time(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec + time.tv_nsec * 1e-9;
}

static void note(double time, const char *name, const uint8_t *bytes, size_t length)
{
    if (!notes || !length)
        return;
    fprintf(notes, "{\"t\": %.6f, \"%s\": \"", time, name);
    for (size_t i = 0; i < length; i++)
        if (bytes[i] < ' ' || bytes[i] > '~' || bytes[i] == '"' || bytes[i] == '\\')
            fprintf(notes, "\\u%04x", bytes[i]);
        else
            fputc(bytes[i], notes);
    fputs("\"}\n", notes);
    fflush(notes);
}

static void note_state(double time)
{
    if (!notes)
        return;
    fprintf(notes, "{\"t\": %.6f, \"own\": %.6f, \"pose\": [%.6f, %.6f, %.6f], \"duty\": [", time, now,
            wheels.pose[0], wheels.pose[1], wheels.pose[2]);
    for (int i = 0; i < WHEELS; i++)
        fprintf(notes, "%s%.4f", i ? ", " : "", duty[i]);
    fputs("], \"speeds\": [", notes);
    for (int i = 0; i < WHEELS; i++)
        fprintf(notes, "%s%.5f", i ? ", " : "", wheels.speed[i]);
    fputs("]}\n", notes);
    fflush(notes);
}

static void note_figures(double time)
{
    if (notes)
        fprintf(notes, "{\"t\": %.6f, \"resets\": %d, \"stack\": %d, \"busy\": %.4f}\n", time,
                chip_resets(chip), chip_stack(chip), chip_busy(chip));
}

/* Let one turn of simulated time pass. */
static void turn(void)
{
    for (double end = now + TURN - slice / 2; now < end;) {
        now += slice;
        chip_run(chip, now);
        chip_duties(chip, duty);
        wheels_step(&wheels, duty, slice);
        for (int wheel = 0; wheel < WHEELS; wheel++)
            chip_turn(chip, wheel, wheels_count(&wheels, wheel));
    }
    static double noted;
    if (now >= noted) {
        noted += NOTE;
        note_state(scripted ? now : clock_time());
    }
}

static void obey(const char *order)
{
    uint8_t bytes[1024];
    size_t length = 0;
    unsigned byte, wheel;
    double speed;
    if (sscanf(order, "turn %u %lf", &wheel, &speed) == 2 && wheel < WHEELS) {
        wheels.held[wheel] = 1;
        wheels.held_at[wheel] = speed;
    } else if (sscanf(order, "free %u", &wheel) == 1 && wheel < WHEELS)
        wheels.held[wheel] = 0;
    else if (sscanf(order, "load %u %lf", &wheel, &speed) == 2 && wheel < WHEELS)
        wheels.load[wheel] = speed;
    else if (!strncmp(order, "hang", 4))
        chip_hang(chip);
    else if (!strncmp(order, "send ", 5)) {
        for (order += 5; length < sizeof bytes && sscanf(order, "%2x", &byte) == 1; order += 2)
            bytes[length++] = byte;
        chip_receive(chip, bytes, length);
        note(now, "rx", bytes, length);
    } else if (!strncmp(order, "end", 3))
        ended = 1;
}

static void run_script(void)
{
    static char line[4096];
    uint8_t bytes[256];
    double time, at;
    int used;
    while (!ended && fgets(line, sizeof line, stdin)) {
        if (sscanf(line, "%lf %n", &time, &used) < 1)
            continue;
        while (now < time - slice) {
            turn();
            size_t length = chip_sent(chip, bytes, sizeof bytes, &at);
            note(at, "tx", bytes, length);
        }
        obey(line + used);
    }
    note_figures(now);
}

static void exchange(void)
{
    static const char *device = "";
    static int was_plugged;
    uint8_t bytes[4096];
    double at;
    if (plugged != was_plugged) {
        device = cable_plug(was_plugged = plugged);
        if (now > TURN)
            note(clock_time(), "device", (const uint8_t *)device, strlen(device));
        if (now > TURN && !plugged && notes)
            fprintf(notes, "{\"t\": %.6f, \"device\": \"\"}\n", clock_time());
        if (now <= TURN)
            printf("serving a robot on %s\n", device), fflush(stdout);
    }
    size_t length = cable_read(bytes, sizeof bytes);
    chip_receive(chip, bytes, length);
    note(clock_time(), "rx", bytes, length);
    length = chip_sent(chip, bytes, sizeof bytes, &at);
    if (length && !silent)
        cable_write(bytes, length);
}

static void run_in_real_time(void)
{
    double deadline = clock_time();
    while (!ended) {
        turn();
        exchange();
        deadline += TURN;
        double left = deadline - clock_time();
        if (left < -STALL) {
            deadline -= left;
            if (notes)
                fprintf(notes, "{\"t\": %.6f, \"lost\": %.6f}\n", clock_time(), -left);
        } else if (left > 0.0)
            nanosleep(&(struct timespec){.tv_nsec = left * 1e9}, NULL);
    }
    cable_plug(0);
    note_figures(clock_time());
}

static void four(const char *text, double numbers[WHEELS])
{
    double *n = numbers;
    if (sscanf(text, "%lf,%lf,%lf,%lf", n, n + 1, n + 2, n + 3) != WHEELS) {
        fprintf(stderr, "avr_board: %s: four numbers, as 1,1,0.9,1.1\n", text);
        exit(2);
    }
}

int main(int argc, char **argv)
{
    if (argc < 3) {
        fputs("usage: avr_board CHIP ELF [--script | --silent] [--log FILE] [--name LINK] ...\n", stderr);
        return 2;
    }
    for (int i = 3; i < argc; i++) {
        const char *value = i + 1 < argc ? argv[i + 1] : "";
        if (!strcmp(argv[i], "--script"))
            scripted = 1;
        else if (!strcmp(argv[i], "--silent"))
            silent = 1;
        else if (!strcmp(argv[i], "--log") && !(notes = fopen(value, "w")))
            return perror(value), 2;
        else if (!strcmp(argv[i], "--name"))
            cable_begin(value);
        else if (!strcmp(argv[i], "--gain"))
            four(value, wheels.gain);
        else if (!strcmp(argv[i], "--lag"))
            four(value, wheels.time_constant);
        else if (!strcmp(argv[i], "--way"))
            four(value, wheels.way);
        else if (!strcmp(argv[i], "--counts"))
            wheels.counts_per_turn = atof(value);
        else if (!strcmp(argv[i], "--full"))
            wheels.full_speed = atof(value);
    }
    if (slice * wheels.full_speed * wheels.counts_per_turn / (2.0 * M_PI) > 0.35)
        slice = FINE;
    for (int i = 0; i < 4; i++)
        signal((int[]){SIGTERM, SIGINT, SIGUSR1, SIGUSR2}[i], on_signal);
    chip = chip_new(argv[1], argv[2]);
    scripted ? run_script() : run_in_real_time();
    return 0;
}
