// The protocol core of a trigger box, line for line what ../protocol.py, box.py and wire.py do; names are theirs.
#include "protocol.h"

#include <avr/pgmspace.h>
#include <stdarg.h>
#include <string.h>
#include <util/crc16.h>

enum { FRAMING = 1, VERB, STATE, RANGE, BUSY, HARDWARE, FAULT, SESSION, PATTERNS, LIMIT };
enum { NO_FAULT, WATCHDOG, ON_TIME, DUTY, LIGHT };
enum state { IDLE, READY, LIT, PLAYING, WAITING };

#define MAX_LINE 240
#define NUMBERS 10000
#define MISSING 255
#define SLOTS 20
#define SLOT_US 500000UL
#define DUTY_SLACK 20

static char line[MAX_LINE + 1]; // received so far
static uint8_t received;
static bool too_long;

static char reply[MAX_LINE + 1], brief[56]; // the stored answer; events and answers that are not stored
static char *at, *limit;                    // where `say` writes

static char session[5];
static bool is_open;
static uint16_t number = NUMBERS;
static uint8_t reply_length;
static uint64_t heard_us, watchdog_us = 50000;
static uint32_t on_us, boot_id;
static uint16_t duty;

static uint8_t order[MAX_PICKED]; // what is picked, or what of it is loaded: never both
static uint16_t picked, loaded;
static bool is_run; // loaded is a run of the flash from order[0]
static uint32_t gap_us;

static enum state state;
static uint8_t fault;
static bool lit, must_darken;
static uint64_t lit_us, next_us, off_us;
static int16_t shown_index = -1;
static uint32_t shows;
static uint16_t first, count, frames;
static uint32_t exposure_us, period_us;
static const char *failure; // of the board, the words of error HARDWARE

// Text.

static void put(char c) {
    if (at < limit) *at++ = c;
}

static void put_decimal(uint64_t value) {
    char digits[20];
    uint8_t length = 0;
    // Divisions of 64 bits are slow: nine digits at a time.
    do {
        uint32_t part = value > 999999999 ? value % 1000000000 : value;
        value = value > 999999999 ? value / 1000000000 : 0;
        for (uint8_t digit = 0; value ? digit < 9 : part || !digit; digit++, part /= 10) digits[length++] = '0' + part % 10;
    } while (value);
    while (length) put(digits[--length]);
}

static void put_hex(uint32_t value, uint8_t digits) {
    while (digits--) put(pgm_read_byte(&PSTR("0123456789ABCDEF")[value >> 4 * digits & 15]));
}

static void say_list(const char *form, va_list list) {
    for (char c; (c = pgm_read_byte(form)); form++) {
        if (c != '%') {
            put(c);
            continue;
        }
        switch (pgm_read_byte(++form)) {
        case 'u': put_decimal(va_arg(list, uint32_t)); break;
        case 't': put_decimal(va_arg(list, uint64_t)); break;
        case 'x': put_hex(va_arg(list, uint32_t), 8); break;
        case 's':
            for (const char *text = va_arg(list, const char *); *text;) put(*text++);
            break;
        case 'S': say_list(va_arg(list, const char *), list); break;
        }
    }
}

// %u: uint32_t, %t: uint64_t, %x: uint32_t as eight digits, %s: in memory, %S: in the program.
static void say(const char *form, ...) {
    va_list list;
    va_start(list, form);
    say_list(form, list);
    va_end(list);
}
#define SAY(form, ...) say(PSTR(form), ##__VA_ARGS__)
#define U(value) ((uint32_t)(value))

static void begin(char *buffer, uint8_t size) {
    at = buffer;
    limit = buffer + size - 6; // room for the checksum and the end
}

static uint16_t crc16(const char *text, uint8_t length) {
    uint16_t crc = 0xFFFF;
    while (length--) crc = _crc_xmodem_update(crc, *text++);
    return crc;
}

static uint8_t finish(char *buffer) {
    uint16_t crc = crc16(buffer, at - buffer);
    limit += 6;
    put('*');
    put_hex(crc, 4);
    put('\n');
    return at - buffer;
}

// Send a line that is not stored; an answer that is being written goes on.
static void send_brief(const char *form, ...) {
    char *answer = at, *answer_limit = limit;
    begin(brief, sizeof brief);
    va_list list;
    va_start(list, form);
    say_list(form, list);
    va_end(list);
    board_send(brief, finish(brief));
    at = answer, limit = answer_limit;
}
#define SEND(form, ...) send_brief(PSTR(form), ##__VA_ARGS__)

// Light.

static uint32_t slots[SLOTS]; // lit µs of each half second
static uint64_t until_us;
static uint8_t slot;
static uint32_t slot_us;

static void note_light(uint64_t now_us, bool was_lit) {
    if (now_us - until_us > SLOTS * SLOT_US) {
        for (uint8_t each = 0; each < SLOTS; each++) slots[each] = was_lit ? SLOT_US : 0;
        until_us = now_us;
        slot = now_us / SLOT_US % SLOTS;
        slot_us = now_us % SLOT_US;
    }
    while (until_us < now_us) {
        uint32_t step_us = SLOT_US - slot_us;
        if (now_us - until_us < step_us) step_us = now_us - until_us;
        if (!slot_us) slots[slot] = 0;
        if (was_lit) slots[slot] += step_us;
        until_us += step_us;
        slot_us += step_us;
        if (slot_us == SLOT_US) slot_us = 0, slot = (slot + 1) % SLOTS;
    }
}

static int32_t light_left_us(void) {
    int32_t left_us = (duty + DUTY_SLACK < 1000 ? duty + DUTY_SLACK : 1000) * 10000L;
    for (uint8_t each = 0; each < SLOTS; each++) left_us -= slots[each];
    return left_us;
}

static bool light_used_up(void) { return duty < 1000 && light_left_us() <= 0; }

static void switch_off(void) {
    must_darken = true;
    if ((failure = board_switch_off())) {
        if (fault != LIGHT) {
            fault = LIGHT;
            SEND("! FAULT %u", U(LIGHT));
        }
        return;
    }
    must_darken = false;
    note_light(board_time_us(), lit);
    lit = false;
}

static void raise_fault(uint8_t code) {
    switch_off();
    state = loaded ? READY : IDLE;
    fault = code;
    SEND("! FAULT %u", U(code));
}

static uint8_t darken(enum state next) {
    state = next;
    if (next == IDLE) loaded = 0;
    fault = NO_FAULT;
    switch_off();
    static const char stays[] = "the light does not go out";
    failure = must_darken ? stays : NULL;
    return must_darken ? HARDWARE : 0;
}

static uint8_t pattern_of(uint16_t index) { return is_run ? order[0] + index : order[index]; }

static uint8_t light(uint64_t *t_us) {
    if ((failure = board_light())) return HARDWARE;
    *t_us = board_time_us();
    note_light(*t_us, false);
    lit = true;
    lit_us = *t_us;
    shows++;
    return 0;
}

static uint8_t light_frame(uint64_t *t_us) {
    if (light(t_us)) return HARDWARE;
    if ((failure = board_pulse(exposure_us))) return HARDWARE;
    off_us = board_time_us() + exposure_us + about.hold_us;
    shown_index = first + frames++;
    SEND("! FRAME %u %t", U(shown_index), *t_us);
    return 0;
}

static uint8_t advance_sequence(uint64_t now_us) {
    uint64_t t_us;
    if (lit && now_us >= off_us) {
        switch_off();
        if (frames == count) {
            state = READY;
            SEND("! DONE %u", U(count));
            return 0;
        }
        if ((failure = board_select(pattern_of(first + frames)))) return HARDWARE;
        next_us += period_us;
        t_us = board_time_us();
        if (next_us < t_us) next_us = t_us;
    } else if (!lit && state == PLAYING && now_us >= next_us) {
        return light_frame(&t_us);
    }
    return 0;
}

void box_poll(void) {
    uint64_t now_us = board_time_us();
    note_light(now_us, lit);
    if (must_darken) switch_off();
    if (state >= LIT && now_us - heard_us > watchdog_us) raise_fault(WATCHDOG);
    else if (lit && now_us - lit_us > on_us) raise_fault(ON_TIME);
    else if (lit && light_used_up()) raise_fault(DUTY);
    else if (state >= PLAYING && advance_sequence(now_us)) raise_fault(LIGHT);
}

int64_t box_wait_us(void) {
    int64_t now_us = board_time_us(), due_us = INT64_MAX, each_us;
#define DUE(value) if ((each_us = (value)) < due_us) due_us = each_us
    if (must_darken) DUE(now_us + 1000);
    if (lit) DUE(lit_us + on_us);
    if (lit && duty < 1000) DUE(now_us + (light_left_us() > 1 ? light_left_us() : 1));
    if (state >= LIT) DUE(heard_us + watchdog_us);
    if (state == PLAYING || (state == WAITING && lit)) DUE(lit ? off_us : next_us);
    return due_us == INT64_MAX ? -1 : due_us > now_us ? due_us - now_us : 0;
}

// Commands of the host.

static char *body; // of the answer, behind session and number

static uint8_t refuse(uint8_t code, const char *form, ...) {
    at = body;
    SAY(" ERR %u ", U(code));
    va_list list;
    va_start(list, form);
    say_list(form, list);
    va_end(list);
    return code;
}
#define REFUSE(code, form, ...) refuse(code, PSTR(form), ##__VA_ARGS__)

static PGM_P state_name(void) {
    switch (state) {
    case IDLE: return PSTR("idle");
    case READY: return PSTR("ready");
    case LIT: return PSTR("lit");
    case PLAYING: return PSTR("playing");
    default: return PSTR("waiting");
    }
}

// The next word as a number; moves `*text` behind it. False if it is none of 32 bits.
static bool take_number(const char **text, uint8_t base, uint32_t *value) {
    const char *word = *text;
    for (*value = 0; **text && **text != ' '; ++*text) {
        char c = **text | 0x20;
        uint8_t digit = c >= 'a' ? c - 'a' + 10 : **text - '0';
        if (digit >= base || *value > (0xFFFFFFFF - digit) / base) return false;
        *value = *value * base + digit;
    }
    bool found = *text > word;
    if (**text == ' ') ++*text;
    return found;
}

static uint8_t count_words(const char *text) {
    uint8_t words = text != NULL;
    for (; text && *text; text++) words += *text == ' ';
    return words;
}

static uint32_t crc32_update(uint32_t crc, uint32_t value) {
    static const uint32_t table[16] PROGMEM = {
        0x00000000, 0x1DB71064, 0x3B6E20C8, 0x26D930AC, 0x76DC4190, 0x6B6B51F4, 0x4DB26158, 0x5005713C,
        0xEDB88320, 0xF00F9344, 0xD6D6A3E8, 0xCB61B38C, 0x9B64C2B0, 0x86D3D2D4, 0xA00AE278, 0xBDBDF21C,
    };
    for (int8_t byte = 24; byte >= 0; byte -= 8) {
        crc ^= value >> byte & 0xFF;
        for (uint8_t nibble = 0; nibble < 2; nibble++) crc = crc >> 4 ^ pgm_read_dword(&table[crc & 15]);
    }
    return crc;
}

// CRC-32 of the checksums of patterns: `length` of the flash from `start`, or those picked.
static uint32_t checksum(const uint8_t *patterns, uint8_t start, uint16_t length) {
    uint32_t crc = 0xFFFFFFFF;
    for (uint16_t each = 0; each < length; each++)
        crc = crc32_update(crc, board_crc32(patterns ? patterns[each] : start + each));
    return ~crc;
}

static uint8_t find_pattern(uint32_t crc32) {
    for (uint8_t each = 0; each < about.count; each++)
        if (board_crc32(each) == crc32) return each;
    return MISSING;
}

static uint8_t require_no_fault(void) { return fault ? REFUSE(FAULT, "%u", U(fault)) : 0; }

static uint8_t require_duty(void) { return light_used_up() ? REFUSE(LIMIT, "duty %u", U(duty)) : 0; }

static uint8_t require_light(uint32_t index) {
    uint8_t code = require_no_fault();
    if (code) return code;
    if (!loaded || state >= PLAYING) return REFUSE(STATE, "%S", state_name());
    if (index >= loaded) return REFUSE(RANGE, "%u of %u", index, U(loaded));
    return require_duty();
}

#define TRY(call) do { uint8_t code = (call); if (code) return code; } while (0)
#define ON_BOARD(call) do { if ((failure = (call))) return HARDWARE; } while (0)

static uint8_t hello(const uint32_t *n) {
    uint32_t watchdog_ms = n[1], on_ms = n[2], bright = n[4];
    picked = 0;
    TRY(darken(IDLE));
    is_open = false;
    if (n[0] != 1) return REFUSE(RANGE, "speaks SLTP/1");
    if (watchdog_ms < 50 || on_ms < 1 || n[3] < 1 || n[3] > 1000 || bright < 1 || bright > 1000)
        return REFUSE(RANGE, "limits");
    uint16_t granted = board_set_brightness(bright);
    if (granted > bright) return REFUSE(RANGE, "bright %u", U(granted));
    if (watchdog_ms > about.watchdog_ms) watchdog_ms = about.watchdog_ms;
    if (on_ms > about.on_ms) on_ms = about.on_ms;
    duty = n[3] < about.duty ? n[3] : about.duty;
    watchdog_us = watchdog_ms * 1000;
    on_us = on_ms * 1000;
    is_open = true;
    SAY(" sltp=1 model=%s fw=%s w=%u h=%u max=%u boot=%x watchdog_ms=%u on_ms=%u duty=%u bright=%u", about.model,
        about.firmware, U(about.width_px), U(about.height_px), U(about.count), boot_id, watchdog_ms, on_ms, U(duty),
        U(granted));
    SAY(" light_us=%u error_us=%u gap_us=%u hold_us=%u least_us=%u pick=%u pulse=exposure", about.light_us,
        about.error_us, about.gap_us, about.hold_us, about.least_us, U(MAX_PICKED));
    return 0;
}

static uint8_t ping(const uint32_t *n) {
    SAY(" %t %S %u", board_time_us(), state_name(), U(fault));
    return 0;
}

static uint8_t pick(const char *text) {
    uint32_t start, crc32;
    uint8_t words = count_words(text) - 1;
    take_number(&text, 10, &start);
    TRY(darken(IDLE));
    if (start == 0) picked = 0;
    if (start != picked || start + words > MAX_PICKED)
        return REFUSE(RANGE, "%u after %u, most %u", start, U(picked), U(MAX_PICKED));
    while (words--) {
        take_number(&text, 16, &crc32);
        order[picked++] = find_pattern(crc32);
    }
    SAY(" %u", U(picked));
    for (uint16_t each = start; each < picked; each++)
        if (order[each] == MISSING) SAY(" %u", U(each));
    return 0;
}

static uint8_t load(const uint32_t *n) {
    uint16_t length = picked;
    TRY(darken(IDLE));
    picked = 0;
    is_run = !length || length != n[0] || memchr(order, MISSING, length) || checksum(order, 0, length) != n[1];
    if (is_run) {
        if (n[0] < 1 || n[0] > about.count) return REFUSE(RANGE, "%u of %u", n[0], U(about.count));
        length = n[0];
        for (order[0] = 0; checksum(NULL, order[0], length) != n[1];)
            if (++order[0] + length > about.count)
                return REFUSE(PATTERNS, "%u %x", U(about.count), checksum(NULL, 0, about.count));
    }
    loaded = length;
    uint8_t most = 0;
    for (uint16_t each = 1; each < loaded; each++) {
        uint8_t before = pattern_of(each - 1), after = pattern_of(each);
        // Stepping back restarts at the first pattern.
        uint8_t steps = after > before ? after - before - 1 : after < before ? after : 0;
        if (steps > most) most = steps;
    }
    gap_us = about.gap_us + most * about.step_us;
    state = READY;
    SAY(" %u %u %u", U(loaded), U(order[0]), gap_us);
    return 0;
}

static uint8_t show(const uint32_t *n) {
    uint64_t t_us;
    TRY(require_light(n[0]));
    shown_index = n[0];
    switch_off();
    state = READY;
    ON_BOARD(board_select(pattern_of(n[0])));
    TRY(light(&t_us));
    state = LIT;
    SAY(" %u %t", n[0], t_us);
    return 0;
}

static uint8_t seq(const uint32_t *n) {
    TRY(require_light(n[0]));
    if (n[1] < 1 || n[1] > loaded - n[0] || n[4] > 1)
        return REFUSE(RANGE, "%u patterns from %u, mode %u", n[1], n[0], n[4]);
    uint64_t lit_for_us = (uint64_t)n[2] + about.hold_us;
    if (n[2] < about.least_us || lit_for_us > on_us || n[3] < (uint64_t)n[2] + gap_us)
        return REFUSE(RANGE, "exposure %u period %u", n[2], n[3]);
    if (n[4] == 0 && lit_for_us * 1000 > (uint64_t)duty * n[3]) return REFUSE(LIMIT, "duty %u", U(duty));
    TRY(darken(READY));
    ON_BOARD(board_select(pattern_of(n[0])));
    first = n[0], count = n[1], exposure_us = n[2], period_us = n[3], frames = 0;
    next_us = board_time_us() + about.gap_us;
    state = n[4] == 0 ? PLAYING : WAITING;
    SAY(" %t", next_us);
    return 0;
}

static uint8_t trig(const uint32_t *n) {
    uint64_t t_us;
    TRY(require_no_fault());
    if (state != WAITING) return REFUSE(STATE, "nothing waits");
    if (lit) return REFUSE(STATE, "still lit");
    TRY(require_duty());
    TRY(light_frame(&t_us));
    SAY(" %u %t", U(shown_index), t_us);
    return 0;
}

static uint8_t stop(const uint32_t *n) {
    TRY(darken(loaded ? READY : IDLE));
    SAY(" %u", U(frames));
    return 0;
}

static uint8_t blank(const uint32_t *n) { return darken(loaded ? READY : IDLE); }

static uint8_t status(const uint32_t *n) {
    SAY(" state=%S loaded=%u first=%u", state_name(), U(loaded), U(loaded ? order[0] : 0));
    if (shown_index >= 0) SAY(" index=%u", U(shown_index));
    SAY(" frames=%u shows=%u fault=%u t_us=%t", U(frames), shows, U(fault), board_time_us());
    return 0;
}

static uint8_t bye(const uint32_t *n) {
    picked = 0;
    TRY(darken(IDLE));
    is_open = false;
    return 0;
}

static const struct verb {
    char name[7];
    uint8_t numbers; // that it takes
    uint8_t (*run)(const uint32_t *numbers);
} verbs[] PROGMEM = {
    {"HELLO", 5, hello}, {"PING", 0, ping}, {"PICK", 2, NULL}, {"LOAD", 2, load}, {"SHOW", 1, show},    {"SEQ", 5, seq},
    {"TRIG", 0, trig},   {"STOP", 0, stop}, {"BLANK", 0, blank}, {"STATUS", 0, status}, {"BYE", 0, bye},
};

// text: the words behind the verb; NULL without any.
static uint8_t execute(const char *name, const char *text) {
    struct verb verb;
    for (uint8_t each = 0;; each++) {
        if (each == sizeof verbs / sizeof *verbs) return REFUSE(VERB, "%s", name);
        memcpy_P(&verb, &verbs[each], sizeof verb);
        if (!strcmp(name, verb.name)) break;
    }
    uint32_t numbers[5], number;
    uint8_t words = count_words(text), read = 0;
    bool hexadecimal = !strcmp_P(name, PSTR("PICK")) || !strcmp_P(name, PSTR("LOAD"));
    for (const char *rest = text; read < words && take_number(&rest, read && hexadecimal ? 16 : 10, &number); read++)
        if (read < 5) numbers[read] = number;
    if (!verb.run && words > 2) verb.numbers = words;
    if (read != words || words != verb.numbers) return REFUSE(RANGE, "%s takes %u numbers", name, U(verb.numbers));
    return verb.run ? verb.run(numbers) : pick(text);
}

// Whether the line is whole; then its text ends before the checksum.
static bool is_whole(void) {
    while (received && line[received - 1] == '\r') received--;
    if (too_long || received < 5) return false;
    char given[5], *star = line + received - 5;
    memcpy(given, star, 5);
    for (const char *each = line; each < star; each++)
        if (*each < 32 || *each > 126) return false;
    at = star, limit = star + 6; // the line ends with what it must end with
    finish(line);
    *star = 0;
    at = star + 1;
    return given[0] == '*' && !memcmp(given + 1, at, 4);
}

static void answer(void) {
    const char *text = line + 5;
    uint32_t ours;
    if (!is_whole() || strlen(line) < 5 || strcspn_P(line, PSTR(" ")) != 4 || !take_number(&text, 10, &ours) ||
        text[-1] != ' ' || ours >= NUMBERS) {
        SEND("? ERR 1 bad frame");
        return;
    }
    line[4] = 0;
    bool same = !strcmp(line, session);
    uint64_t now_us = board_time_us();
    char *verb = line + (text - line), *rest = strchr(verb, ' ');
    if (rest) *rest++ = 0;
    if (same) {
        // A sign of life, even if the line is a repetition.
        heard_us = now_us;
        uint16_t ahead = (ours + NUMBERS - number) % NUMBERS;
        if (ahead == 0) {
            board_send(reply, reply_length);
            return;
        }
        if (ahead >= NUMBERS / 2) {
            SEND("%s %u ERR 3 number %u after %u", session, ours, ours, U(number));
            return;
        }
    }
    if (!same || !is_open) {
        if (is_open && now_us - heard_us <= watchdog_us) {
            SEND("%s %u ERR 5 held by %s", line, ours, session);
            return;
        }
        if (strcmp_P(verb, PSTR("HELLO"))) {
            SEND("%s %u ERR 8 say HELLO", line, ours);
            return;
        }
        memcpy(session, line, 5);
        is_open = false;
        heard_us = now_us;
    }
    number = ours;
    begin(reply, sizeof reply);
    SAY("%s %u", session, ours);
    body = at;
    SAY(" OK");
    if (execute(verb, rest) == HARDWARE) {
        const char *why = failure;
        raise_fault(LIGHT);
        REFUSE(HARDWARE, "%s", why);
    }
    reply_length = finish(reply);
    board_send(reply, reply_length);
}

void box_feed(char byte) {
    if (byte != '\n') {
        if (received < MAX_LINE) line[received++] = byte;
        else too_long = true;
        return;
    }
    if (received) answer();
    received = 0;
    too_long = false;
}

void box_begin(uint32_t boot) {
    boot_id = boot;
    switch_off();
}
