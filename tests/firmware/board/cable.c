#define _GNU_SOURCE
#include "cable.h"

#include <fcntl.h>
#include <pty.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <unistd.h>

static const char *link_name;
static int board_end = -1, client_end = -1;
static char device[256];

void cable_begin(const char *name)
{
    link_name = name;
}

static void plug(void)
{
    struct termios settings;
    if (openpty(&board_end, &client_end, device, NULL, NULL)) {
        perror("avr_board: no pseudo-terminal");
        exit(2);
    }
    tcgetattr(client_end, &settings);
    cfmakeraw(&settings);
    cfsetspeed(&settings, B115200);
    tcsetattr(client_end, TCSANOW, &settings);
    fcntl(board_end, F_SETFL, O_NONBLOCK);
    fcntl(board_end, F_SETFD, FD_CLOEXEC);
    if (link_name) {
        unlink(link_name);
        if (symlink(device, link_name))
            perror(link_name);
    }
}

static void pull(void)
{
    if (link_name)
        unlink(link_name);
    close(board_end);
    close(client_end);
    board_end = client_end = -1;
    device[0] = 0;
}

const char *cable_plug(int plugged)
{
    if (plugged && board_end < 0)
        plug();
    else if (!plugged && board_end >= 0)
        pull();
    return device;
}

/* What a UART makes of bytes at another baud rate: garbage, though not the real one's. */
static void garble(uint8_t *bytes, size_t length)
{
    struct termios settings;
    if (tcgetattr(client_end, &settings) || cfgetospeed(&settings) == B115200)
        return;
    for (size_t i = 0; i < length; i++)
        bytes[i] = (bytes[i] * 7 + 0x80) | 0x80;
}

size_t cable_read(uint8_t *bytes, size_t room)
{
    ssize_t length = board_end < 0 ? 0 : read(board_end, bytes, room);
    if (length <= 0)
        return 0;
    garble(bytes, length);
    return length;
}

void cable_write(uint8_t *bytes, size_t length)
{
    if (board_end < 0)
        return;
    garble(bytes, length);
    if (write(board_end, bytes, length) < 0)
        return; /* full: lost, as on a wire */
}
