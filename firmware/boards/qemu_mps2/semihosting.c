#include "semihosting.h"

#include <string.h>

enum { OPEN = 0x01, WRITE = 0x05, READ = 0x06, GET_CMDLINE = 0x15, EXIT_EXTENDED = 0x20 };
enum { APPLICATION_EXIT = 0x20026 };

static int32_t call(uint32_t operation, const void *block) {
    register uint32_t r0 __asm("r0") = operation;
    register const void *r1 __asm("r1") = block;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return (int32_t)r0;
}

int32_t semihosting_open(const char *path, semihosting_mode mode) {
    const uint32_t block[3] = {(uint32_t)(uintptr_t)path, (uint32_t)mode, (uint32_t)strlen(path)};
    return call(OPEN, block);
}

int semihosting_read(int32_t handle, void *buffer, size_t bytes) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)buffer, (uint32_t)bytes};
    return call(READ, block) == 0;
}

int semihosting_write(int32_t handle, const void *buffer, size_t bytes) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)buffer, (uint32_t)bytes};
    return call(WRITE, block) == 0;
}

size_t semihosting_arguments(char *buffer, size_t bytes, char **arguments, size_t limit) {
    const uint32_t block[2] = {(uint32_t)(uintptr_t)buffer, (uint32_t)bytes};
    if (call(GET_CMDLINE, block) != 0) {
        return 0;
    }
    size_t count = 0;
    int inside = 0;
    for (char *c = buffer; *c != '\0'; c++) {
        if (*c == ' ') {
            *c = '\0';
            inside = 0;
        } else if (!inside && count < limit) {
            arguments[count++] = c;
            inside = 1;
        }
    }
    return count;
}

void semihosting_exit(int code) {
    const uint32_t block[2] = {APPLICATION_EXIT, (uint32_t)code};
    call(EXIT_EXTENDED, block);
    for (;;) {
    }
}
