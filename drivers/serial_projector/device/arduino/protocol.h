// SLTP/1, the protocol of a trigger box, as in ../protocol.py: what it needs of a board, and what it offers.
#pragma once
#include <stdbool.h>
#include <stdint.h>

#define MAX_PATTERNS 255 // of the flash: an index is a byte
#define MAX_PICKED 512

// Properties of the box for HELLO; see BoxDescription in ../box.py.
struct about {
    char model[16], firmware[8];
    uint16_t width_px, height_px, count;
    uint32_t light_us, error_us, gap_us, hold_us, least_us, step_us;
    uint32_t watchdog_ms, on_ms, duty;
};
extern struct about about;

// The board, see BoxHardware in ../box.py. A function that may fail returns the reason, or NULL.
uint64_t board_time_us(void);
const char *board_select(uint8_t pattern);
const char *board_light(void);
const char *board_switch_off(void);
const char *board_pulse(uint32_t us);
uint16_t board_set_brightness(uint16_t permille);
uint32_t board_crc32(uint8_t pattern);
void board_send(const char *line, uint8_t length);

void box_begin(uint32_t boot);
void box_feed(char byte);   // one byte that came
void box_poll(void);        // do all due work; as often as possible
int64_t box_wait_us(void);  // until `box_poll` has work; -1: only a command can cause any
