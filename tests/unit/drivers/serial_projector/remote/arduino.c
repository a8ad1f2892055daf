// A board for tests, on the simulator: the protocol core of the Arduino's firmware, whose board is at the other end of
// a channel of bytes, GPIOR0. See remote.py.
#include "protocol.h"

#include <avr/io.h>
#include <stddef.h>

struct about about;
static uint32_t crc32[26];
static char reason[32], data[255];

static void give(const void *data, uint8_t length) {
    for (const uint8_t *each = data; length--; each++) GPIOR0 = *each;
}

static void take(void *data, uint8_t length) {
    for (uint8_t *each = data; length--; each++) *each = GPIOR0;
}

static const char *ask(char what, const void *data, uint8_t length) {
    uint8_t answer;
    give(&what, 1);
    give(data, length);
    take(&answer, 1);
    if (!answer) return NULL;
    take(reason, answer);
    reason[answer] = 0;
    return reason;
}

uint64_t board_time_us(void) {
    uint64_t us;
    give("t", 1);
    take(&us, 8);
    return us;
}

const char *board_select(uint8_t pattern) { return ask('s', &pattern, 1); }
const char *board_light(void) { return ask('l', NULL, 0); }
const char *board_switch_off(void) { return ask('d', NULL, 0); }
const char *board_pulse(uint32_t us) { return ask('p', &us, 4); }

uint16_t board_set_brightness(uint16_t permille) {
    give("b", 1);
    give(&permille, 2);
    take(&permille, 2);
    return permille;
}

uint32_t board_crc32(uint8_t pattern) { return crc32[pattern]; }

void board_send(const char *line, uint8_t length) {
    give("o", 1);
    give(&length, 1);
    give(line, length);
}

int main(void) {
    uint32_t boot;
    take(&boot, 4);
    take(&about, sizeof about);
    take(crc32, 4 * about.count);
    box_begin(boot);
    while (1) {
        uint8_t what, length;
        int64_t wait_us;
        give(".", 1);
        take(&what, 1);
        if (what == 'w') {
            wait_us = box_wait_us();
            give("r", 1);
            give(&wait_us, 8);
            continue;
        }
        take(&length, 1);
        take(data, length);
        box_poll();
        for (uint8_t each = 0; each < length; each++) box_feed(data[each]);
    }
}
