/* Files and exit through the emulator (ARM semihosting, version 2). */
#ifndef SEMIHOSTING_H
#define SEMIHOSTING_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

typedef enum { SEMIHOSTING_READ = 1, SEMIHOSTING_WRITE = 5 } semihosting_mode;

static inline int32_t semihosting_call(uint32_t operation, const void *block) {
    register uint32_t r0 __asm("r0") = operation;
    register const void *r1 __asm("r1") = block;
    __asm volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
    return (int32_t)r0;
}

/* A handle, or -1. */
static inline int32_t semihosting_open(const char *path, semihosting_mode mode) {
    const uint32_t block[3] = {(uint32_t)(uintptr_t)path, (uint32_t)mode, (uint32_t)strlen(path)};
    return semihosting_call(0x01, block);
}

/* Whether all bytes were read, or written. */
static inline int semihosting_read(int32_t handle, void *buffer, size_t bytes) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)buffer, (uint32_t)bytes};
    return semihosting_call(0x06, block) == 0;
}

static inline int semihosting_write(int32_t handle, const void *buffer, size_t bytes) {
    const uint32_t block[3] = {(uint32_t)handle, (uint32_t)(uintptr_t)buffer, (uint32_t)bytes};
    return semihosting_call(0x05, block) == 0;
}

__attribute__((noreturn)) static inline void semihosting_exit(int code) {
    const uint32_t block[2] = {0x20026 /* application exit */, (uint32_t)code};
    for (;;) {
        (void)semihosting_call(0x20, block);
    }
}

#endif
