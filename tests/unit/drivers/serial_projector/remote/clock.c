// The clock of the Arduino's firmware, read while turns of the timer are not counted yet: LAMP is lit once it went back,
// STEP tells that it runs.
#define main firmware
#include "main.c"
#undef main

int main(void) {
    DDRD = _BV(STEP) | _BV(LAMP);
    TCCR1B = _BV(CS11);
    TIMSK1 = _BV(TOIE1);
    sei();
    for (uint64_t last = 0, now; ; last = now) {
        cli();
        _delay_us(50);
        now = board_time_us();
        sei();
        if (now < last) PORTD |= _BV(LAMP);
        if (now > 1000000) PORTD |= _BV(STEP);
    }
}
