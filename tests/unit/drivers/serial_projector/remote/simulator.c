// An ATmega328P at 16 MHz on libsimavr, driven over stdin and stdout.
//
//     simulator channel ELF    GPIOR0 is a channel of bytes: what is written goes to stdout, what is read comes from stdin
//     simulator board ELF      serial port, pins and cycles, by lines:
//                              `run CYCLES` goes on for so many; `send HEX` gives the serial port bytes, as fast as it
//                              takes them; `ready 0|1` sets the pin READY. `run` answers with what happened, each with its
//                              cycle: `CYCLE uart HEX`, `CYCLE PIN 0|1`, and last `CYCLE end LOWEST_STACK_POINTER`
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define GPIOR0 0x3E
#define TCCR1A 0x80
#define TIMER1_COMPA 11
#define BYTE_CYCLES 1360 // of 10 bits at 117647 baud

static avr_t *avr;

static void channel_write(avr_t *mcu, avr_io_addr_t address, uint8_t byte, void *unused) { putchar(byte); }

static uint8_t channel_read(avr_t *mcu, avr_io_addr_t address, void *unused) {
    fflush(stdout);
    int byte = getchar();
    if (byte == EOF) exit(0);
    return byte;
}

static void heard(avr_irq_t *irq, uint32_t byte, void *unused) {
    printf("%llu uart %02X\n", (unsigned long long)avr->cycle, byte);
}

static void changed(avr_irq_t *irq, uint32_t level, void *name) {
    if (irq->value != level) printf("%llu %s %u\n", (unsigned long long)avr->cycle, (char *)name, level & 1);
}

static void watch(char port, int pin, char *name) {
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), pin), changed, name);
}

// Timer 1's compare output. simavr 1.6 moves the pin of a plain timer at its overflows, too, as if it were PWM's.
static void matched(avr_irq_t *irq, uint32_t pending, void *unused) {
    static unsigned level = 2;
    unsigned mode = avr->data[TCCR1A] >> 6;
    if (pending && mode >= 2 && level != mode - 2) printf("%llu camera %u\n", (unsigned long long)avr->cycle, level = mode - 2);
}

static void run_board(void) {
    static uint8_t waiting[65536];
    unsigned first = 0, count = 0, lowest = 0xFFFF;
    char line[2048];
    avr_cycle_count_t next_byte = 0;
    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), heard, NULL);
    avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_t *ready = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('D'), 5);
    watch('D', 2, "step");
    watch('D', 3, "home");
    watch('D', 4, "lamp");
    avr_irq_register_notify(avr_get_interrupt_irq(avr, TIMER1_COMPA) + AVR_INT_IRQ_PENDING, matched, NULL);
    while (fgets(line, sizeof line, stdin)) {
        unsigned long long cycles;
        unsigned value;
        if (sscanf(line, "ready %u", &value) == 1) avr_raise_irq(ready, value);
        else if (!strncmp(line, "send ", 5))
            for (char *hex = line + 5; sscanf(hex, "%2x", &value) == 1; hex += 2) waiting[(first + count++) % sizeof waiting] = value;
        else if (sscanf(line, "run %llu", &cycles) == 1) {
            for (avr_cycle_count_t until = avr->cycle + cycles; avr->cycle < until;) {
                if (count && avr->cycle >= next_byte) {
                    avr_raise_irq(input, waiting[first]);
                    first = (first + 1) % sizeof waiting;
                    count--;
                    next_byte = avr->cycle + BYTE_CYCLES;
                }
                if (avr_run(avr) >= cpu_Done) {
                    fprintf(stderr, "the program ended\n");
                    exit(1);
                }
                unsigned sp = avr->data[R_SPL] | avr->data[R_SPH] << 8;
                if (sp && sp < lowest && avr->cycle > 1000) lowest = sp;
            }
            printf("%llu end %u\n", (unsigned long long)avr->cycle, lowest);
            fflush(stdout);
        }
    }
}

int main(int count, char **words) {
    elf_firmware_t firmware = {0};
    // simavr says on stdout what it loads.
    int answers = dup(1);
    dup2(2, 1);
    if (count != 3 || elf_read_firmware(words[2], &firmware)) return 2;
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    avr->log = LOG_ERROR;
    firmware.frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    fflush(stdout);
    dup2(answers, 1);
    if (!strcmp(words[1], "board")) {
        run_board();
        return 0;
    }
    avr_register_io_write(avr, GPIOR0, channel_write, NULL);
    avr_register_io_read(avr, GPIOR0, channel_read, NULL);
    while (avr_run(avr) < cpu_Done) continue;
    return 1;
}
