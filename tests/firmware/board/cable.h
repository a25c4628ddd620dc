/* A pseudo-terminal that can be unplugged, and plugged in again under another name. */
#ifndef CABLE_H
#define CABLE_H

#include <stddef.h>
#include <stdint.h>

/* `name` is a symbolic link that always points to the device; NULL for none. */
void cable_begin(const char *name);

/* Plug or unplug; returns the device's path, "" without one. */
const char *cable_plug(int plugged);

/* Read what a client has sent; 0 if nothing. */
size_t cable_read(uint8_t *bytes, size_t room);

/* Send to the client; bytes that nobody reads are lost, and those for another baud rate garbled. */
void cable_write(uint8_t *bytes, size_t length);

#endif
