/* Start of a Cortex-M program without an operating system, and output by semihosting.

   The vector table, the floating-point unit, the initial data, and main; nothing else. There is no
   heap: linking fails if something asks for one. */
#include <stdint.h>

extern uint32_t stack_end, data_begin, data_end, data_load, bss_begin, bss_end;
int main(void);

static int semihost(int operation, const void *argument) {
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

void say(const char *text) { semihost(0x04, text); }

void stop(int status) {
    const uint32_t block[2] = {0x20026, (uint32_t)status}; /* ADP_Stopped_ApplicationExit */
    semihost(0x20, block);
    for (;;) {
    }
}

void reset_handler(void) {
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the floating-point unit */
    __asm__ volatile("dsb\n isb");
    for (uint32_t *from = &data_load, *to = &data_begin; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_begin; to < &bss_end;) *to++ = 0;
    stop(main());
}

static void fault(void) {
    say("fault\n");
    stop(1);
}

__attribute__((section(".vectors"), used)) static void *const vectors[16] = {
    &stack_end, reset_handler, fault, fault, fault, fault, fault};
