/* Start-up of a bare-metal Cortex-M4 with FPU: vectors, memory, then main. Linker scripts define the symbols. */
#include <stdint.h>
#include <string.h>

extern uint32_t stack_top[];
extern uint8_t data_start[], data_end[], data_load[], bss_start[], bss_end[];

int main(void);
void reset(void);
void fault(void);

/* Called when main returns or the processor faults; each board defines it. */
__attribute__((noreturn)) void board_exit(int code);

void fault(void) {
    board_exit(127);
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))stack_top, reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault, fault, 0, fault, fault,
};

__attribute__((noreturn)) void reset(void) {
    /* CPACR: full access to the FPU, before the first instruction that uses it. */
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm volatile("dsb\n isb" ::: "memory");
    memcpy(data_start, data_load, (size_t)(data_end - data_start));
    memset(bss_start, 0, (size_t)(bss_end - bss_start));
    board_exit(main());
}
