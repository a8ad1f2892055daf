// The pins of a trigger box: an Arduino Uno or Nano (ATmega328P at 16 MHz) and a stepping light engine, as ../main.py.
//
//     D2  STEP    out, engine's trigger input      D9  CAMERA  out, cameras' trigger inputs
//     D3  HOME    out, engine's reset input        D5  READY   in, engine shows the selected pattern
//     D4  LAMP    out, LED enable, 10 kΩ to ground D0, D1      serial, 115200 baud, by the board's USB port
//
// The resistor on LAMP keeps it dark while the box starts, restarts or has no firmware. The watchdog timer restarts
// the box if this program hangs for a second. Edges of CAMERA come from Timer 1's compare output, exact to 0.5 µs.
#include "protocol.h"

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/wdt.h>
#include <stddef.h>
#include <util/atomic.h>
#include <util/delay.h>

#ifdef __has_include
#if __has_include("patterns.h") // written by `slrig patterns`
#include "patterns.h"
#endif
#endif
#ifndef PATTERNS
#define PATTERNS
#define WIDTH_PX 912
#define HEIGHT_PX 1140
#endif

enum { STEP = PD2, HOME = PD3, LAMP = PD4, READY = PD5, CAMERA = PB1 };

// Set as the engine and the cameras need it; see ../main.py for what they mean.
#ifndef CAMERA_LEVEL
#define CAMERA_LEVEL 1 // 0 for XTR of a Raspberry Pi global shutter camera
#endif
#define HOME_LEVEL 1
#define STEPS_TO_FIRST 0
#define HAS_READY 1
#define STEP_US 50
#define SETTLE_US 500
#define READY_US 20000
#define LAMP_US 20
#define PULSE_LESS_US 14
#define HOLD_US 2000 // longer than the program's longest delay, an answer to a command
#define MIN_EXPOSURE_US 200

static const uint32_t crc32[] PROGMEM = {PATTERNS};
#define COUNT (sizeof crc32 / sizeof *crc32)
_Static_assert(COUNT <= MAX_PATTERNS, "too many patterns for this box");

struct about about = {
    .model = "slrig-arduino",
    .firmware = "1.0.0",
    .width_px = WIDTH_PX,
    .height_px = HEIGHT_PX,
    .count = COUNT,
    .light_us = 2UL * STEP_US * (COUNT + 1 + STEPS_TO_FIRST) + (HAS_READY ? READY_US : SETTLE_US) + LAMP_US,
    .error_us = 50,
    .gap_us = HOLD_US + 2 * STEP_US + SETTLE_US + 2000,
    .hold_us = HOLD_US,
    .least_us = MIN_EXPOSURE_US,
    .step_us = 2 * STEP_US,
    .watchdog_ms = 10000,
    .on_ms = 3600000,
    .duty = 1000,
};

// Time: Timer 1 counts 0.5 µs, 32.768 ms a turn.

static volatile uint32_t turns;

ISR(TIMER1_OVF_vect) { turns++; }

uint64_t board_time_us(void) {
    uint32_t high;
    uint16_t low;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        low = TCNT1;
        high = turns;
        // A turn that ended just now is not counted yet.
        if ((TIFR1 & _BV(TOV1)) && low < 0x8000) high++;
    }
    return ((uint64_t)high << 16 | low) >> 1;
}

// The cameras' pulse. The compare output sets the pin; the interrupt only says what the next compare does.

#define AT_REST (CAMERA_LEVEL ? _BV(COM1A1) : _BV(COM1A1) | _BV(COM1A0))
#define ACTIVE (CAMERA_LEVEL ? _BV(COM1A1) | _BV(COM1A0) : _BV(COM1A1))

static volatile uint32_t left_ticks;

ISR(TIMER1_COMPA_vect) {
    if (left_ticks > 0xFFFF) {
        OCR1A += 0x8000;
        left_ticks -= 0x8000;
    } else if (left_ticks) {
        OCR1A += left_ticks;
        left_ticks = 0;
        TCCR1A = AT_REST;
    } else {
        TIMSK1 &= ~_BV(OCIE1A);
    }
}

const char *board_pulse(uint32_t us) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        left_ticks = 2 * (us - PULSE_LESS_US);
        OCR1A = TCNT1 + 32;
        TCCR1A = ACTIVE;
        TIFR1 = _BV(OCF1A);
        TIMSK1 |= _BV(OCIE1A);
    }
    return NULL;
}

// End a pulse that still lasts: the light went out before its time.
static void end_pulse(void) {
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        left_ticks = 0;
        OCR1A = TCNT1 + 32;
        TCCR1A = AT_REST;
    }
}

// The engine.

static int16_t position = -1;

static void send_pulse(uint8_t pin, uint8_t level) {
    for (uint8_t half = 0; half < 2; half++, level = !level) {
        if (level) PORTD |= _BV(pin);
        else PORTD &= ~_BV(pin);
        _delay_us(STEP_US);
    }
}

const char *board_select(uint8_t pattern) {
    if (position < 0 || pattern < position) {
        send_pulse(HOME, HOME_LEVEL);
        for (uint8_t each = 0; each < STEPS_TO_FIRST; each++) send_pulse(STEP, 1);
        position = 0;
    }
    for (; position < pattern; position++) send_pulse(STEP, 1);
    if (!HAS_READY) {
        _delay_us(SETTLE_US);
        return NULL;
    }
    uint64_t begun_us = board_time_us();
    while (!(PIND & _BV(READY))) {
        if (board_time_us() - begun_us > READY_US) {
            position = -1; // unknown: home first, next time
            return "the engine is not READY";
        }
    }
    return NULL;
}

const char *board_light(void) {
    PORTD |= _BV(LAMP);
    _delay_us(LAMP_US);
    return NULL;
}

const char *board_switch_off(void) {
    PORTD &= ~_BV(LAMP);
    end_pulse();
    _delay_us(LAMP_US);
    return NULL;
}

uint16_t board_set_brightness(uint16_t permille) { return 1000; } // it cannot dim

uint32_t board_crc32(uint8_t pattern) { return pgm_read_dword(&crc32[pattern]); }

// The serial port. A line that finds no room is lost; the host asks again.

static volatile uint8_t in_head, in_tail, out_head, out_tail; // heads are written, tails are read
static char in[64], out[256];

ISR(USART_RX_vect) {
    in[in_head] = UDR0;
    in_head = (in_head + 1) % sizeof in;
}

ISR(USART_UDRE_vect) {
    UDR0 = out[out_tail++];
    if (out_tail == out_head) UCSR0B &= ~_BV(UDRIE0);
}

void board_send(const char *line, uint8_t length) {
    if (length > (uint8_t)(out_tail - out_head - 1)) return;
    for (uint8_t each = 0; each < length; each++) out[(uint8_t)(out_head + each)] = line[each];
    out_head += length;
    UCSR0B |= _BV(UDRIE0);
}

int main(void) {
    MCUSR = 0;
    wdt_enable(WDTO_1S);
    DDRD = _BV(STEP) | _BV(HOME) | _BV(LAMP);
    PORTD = HOME_LEVEL ? 0 : _BV(HOME);
    PORTB = CAMERA_LEVEL ? 0 : _BV(CAMERA);
    TCCR1A = AT_REST;
    TCCR1B = _BV(CS11);
    TCCR1C = _BV(FOC1A); // the compare output takes its level at rest
    DDRB = _BV(CAMERA);
    TIMSK1 = _BV(TOIE1);
    UCSR0A = _BV(U2X0);
    UBRR0 = 16; // 117647 baud, 2 % from 115200, as every Arduino
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    // Another number at each start.
    uint32_t boot = eeprom_read_dword(NULL) + 1;
    eeprom_update_dword(NULL, boot);
    sei();
    box_begin(boot);
    while (1) {
        wdt_reset();
        box_poll();
        while (in_tail != in_head) {
            box_feed(in[in_tail]);
            in_tail = (in_tail + 1) % sizeof in;
        }
    }
}
