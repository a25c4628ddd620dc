// The Arduino IDE asks for this file; the program, main() included, is in the .c files beside it.
// What fits your robot is in config.h, the pins are in board.h.
