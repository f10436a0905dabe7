/* Virtual time: a heap of events, and one coroutine for each program. SYS_STATUS and the IRQ line, which wake programs. */
#define _GNU_SOURCE
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <ucontext.h>

#include "model.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#endif

#define STACK_BYTES ((size_t)512 * 1024)
#define MAX_DURATION_S 1e6
#define POLL_S 1e-7

struct coroutine {
    ucontext_t context;
    coroutine *next;
    dw1000_air *air;
    dw1000_chip *chip;
    void (*run)(dw1000_chip *, void *);
    void *argument;
    void *stack;
    uint32_t epoch; /* of its event; events with another epoch are cancelled */
    bool ended;
#if defined(__SANITIZE_ADDRESS__)
    void *fake_stack;
    const void *bottom;
    size_t size;
#endif
};

static void *check_memory(void *memory) {
    if (memory == NULL) {
        fputs("dw1000_model: no memory\n", stderr);
        abort();
    }
    return memory;
}

void *dw1000_allocate(size_t bytes) {
    return check_memory(calloc(1, bytes));
}

static bool is_before(const event *a, const event *b) {
    return a->at != b->at ? a->at < b->at : a->order < b->order;
}

static void insert(dw1000_air *air, event added) {
    size_t at = air->event_count++;
    for (; at > 0 && is_before(&added, &air->events[(at - 1) / 2]); at = (at - 1) / 2) {
        air->events[at] = air->events[(at - 1) / 2];
    }
    air->events[at] = added;
}

static void push(dw1000_air *air, event added) {
    if (air->event_count == air->event_capacity) {
        air->event_capacity = air->event_capacity ? 2 * air->event_capacity : 64;
        air->events = check_memory(realloc(air->events, air->event_capacity * sizeof *air->events));
    }
    added.order = air->order++;
    insert(air, added);
}

static event pop(dw1000_air *air) {
    const event first = air->events[0], last = air->events[--air->event_count];
    const size_t count = air->event_count;
    size_t at = 0;
    for (size_t child = 1; child < count; child = 2 * at + 1) {
        if (child + 1 < count && is_before(&air->events[child + 1], &air->events[child])) {
            child++;
        }
        if (!is_before(&air->events[child], &last)) {
            break;
        }
        air->events[at] = air->events[child];
        at = child;
    }
    air->events[at] = last;
    return first;
}

void dw1000_schedule(dw1000_chip *chip, event_group group, instant at, handler *fire, transmission *frame) {
    dw1000_air *const air = chip->air;
    const event added = {
        .at = at > air->now ? at : air->now,
        .fire = fire,
        .chip = chip,
        .frame = frame,
        .epoch = chip->epoch[group],
        .group = group,
    };
    push(air, added);
}

void dw1000_cancel(dw1000_chip *chip, event_group group) {
    chip->epoch[group]++;
}

static void resume_at(coroutine *program, instant at) {
    const event added = {.at = at, .program = program, .epoch = ++program->epoch, .group = GROUP_POWER};
    push(program->air, added);
}

static void switch_to(coroutine *from, coroutine *to) {
    from->air->current = to;
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(from->ended ? NULL : &from->fake_stack, to->bottom, to->size);
#endif
    (void)swapcontext(&from->context, &to->context);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(from->fake_stack, NULL, NULL);
#endif
}

/* Handle events and run other coroutines until the current coroutine is due. */
static void dispatch(dw1000_air *air) {
    coroutine *const self = air->current;
    for (;;) {
        const event next = pop(air);
        if (next.fire == NULL) {
            if (next.epoch != next.program->epoch || next.program->ended) {
                continue;
            }
            air->now = next.at;
            if (next.program != self) {
                switch_to(self, next.program);
            }
            return;
        }
        if (next.epoch == next.chip->epoch[next.group]) {
            air->now = next.at;
            next.fire(next.chip, next.frame);
        }
    }
}

void dw1000_advance(dw1000_air *air, instant until) {
    if (until < air->now) {
        until = air->now;
    }
    if (air->event_count == 0 || air->events[0].at > until) {
        if (air->current != air->caller || !air->running) {
            air->now = until;
            return;
        }
    }
    resume_at(air->current, until);
    dispatch(air);
}

static void finish_program(coroutine *self) {
    dw1000_air *const air = self->air;
    self->ended = true;
    if (self->chip->program == self) {
        self->chip->program = NULL;
    }
    if (--air->running_programs == 0 && air->running) {
        resume_at(air->caller, air->now);
    }
    dispatch(air);
    abort(); /* an ended program is never resumed */
}

static void program_entry(unsigned high, unsigned low) {
    coroutine *const self = (coroutine *)(((uintptr_t)high << 16 << 16) | (uintptr_t)low);
#if defined(__SANITIZE_ADDRESS__)
    coroutine *const caller = self->air->caller;
    const void *bottom;
    size_t size;
    __sanitizer_finish_switch_fiber(NULL, &bottom, &size);
    if (caller->bottom == NULL) {
        caller->bottom = bottom;
        caller->size = size;
    }
#endif
    self->run(self->chip, self->argument);
    finish_program(self);
}

bool dw1000_create_caller(dw1000_air *air) {
    air->caller = calloc(1, sizeof *air->caller);
    if (air->caller == NULL) {
        return false;
    }
    air->caller->air = air;
    air->current = air->caller;
    return true;
}

/* Free programs that have ended, and their events; or all programs. */
static void free_programs(dw1000_air *air, bool all) {
    const size_t count = air->event_count;
    air->event_count = 0;
    for (size_t i = 0; i < count; i++) {
        const event kept = air->events[i];
        if (kept.program == NULL || !kept.program->ended) {
            insert(air, kept); /* the write position is never after the read position */
        }
    }
    for (coroutine **at = &air->programs; *at != NULL;) {
        coroutine *const program = *at;
        if (all || (program->ended && program != air->current)) {
            *at = program->next;
            (void)munmap(program->stack, STACK_BYTES);
            free(program);
        } else {
            at = &program->next;
        }
    }
}

void dw1000_free_programs(dw1000_air *air) {
    free_programs(air, true);
    free(air->caller);
    free(air->events);
}

void dw1000_program(dw1000_chip *chip, void (*run)(dw1000_chip *, void *), void *context) {
    dw1000_air *const air = chip->air;
    if (chip->program != NULL) {
        chip->program->ended = true;
        chip->program = chip->waiter = NULL;
        air->running_programs--;
    }
    free_programs(air, false);
    coroutine *const program = dw1000_allocate(sizeof *program);
    program->air = air;
    program->chip = chip;
    program->run = run;
    program->argument = context;
    program->stack =
        mmap(NULL, STACK_BYTES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (program->stack == MAP_FAILED || getcontext(&program->context) != 0) {
        check_memory(NULL);
    }
#if defined(__SANITIZE_ADDRESS__)
    program->bottom = program->stack;
    program->size = STACK_BYTES;
#endif
    program->context.uc_stack.ss_sp = program->stack;
    program->context.uc_stack.ss_size = STACK_BYTES;
    makecontext(&program->context, (void (*)(void))program_entry, 2, (unsigned)((uintptr_t)program >> 16 >> 16),
                (unsigned)(uintptr_t)program);
    program->next = air->programs;
    air->programs = chip->program = program;
    air->running_programs++;
    resume_at(program, air->now);
}

/* Convert seconds to units; 0 for negative values and NaN. */
static instant seconds_to_units(double seconds) {
    if (!(seconds > 0)) {
        return 0;
    }
    return (instant)llround(fmin(seconds, MAX_DURATION_S) * (double)UNITS_PER_SECOND);
}

double dw1000_seconds_now(const dw1000_air *air) {
    return (double)air->now / (double)UNITS_PER_SECOND;
}

double dw1000_run(dw1000_air *air, double seconds) {
    air->running = air->running_programs != 0;
    dw1000_advance(air, air->now + seconds_to_units(seconds));
    air->running = false;
    return dw1000_seconds_now(air);
}

void dw1000_delay(dw1000_chip *chip, double s) {
    dw1000_advance(chip->air, chip->air->now + seconds_to_units(s));
}

/* Polling takes time, so that a polling loop advances the virtual time. */
static void poll_delay(dw1000_air *air) {
    if (air->current != air->caller) {
        dw1000_advance(air, air->now + seconds_to_units(POLL_S));
    }
}

double dw1000_now(dw1000_chip *chip) {
    poll_delay(chip->air);
    return dw1000_seconds_now(chip->air);
}

int dw1000_irq(dw1000_chip *chip) {
    poll_delay(chip->air);
    return chip->line;
}

void dw1000_wait(dw1000_chip *chip, double at_most_s) {
    if (chip->line) {
        return;
    }
    chip->waiter = chip->air->current;
    dw1000_advance(chip->air, chip->air->now + seconds_to_units(at_most_s));
    chip->waiter = NULL;
}

static void wake_waiter(dw1000_chip *chip) {
    if (chip->waiter != NULL) {
        resume_at(chip->waiter, chip->air->now);
        chip->waiter = NULL;
    }
}

uint64_t dw1000_status(const dw1000_chip *chip) {
    const uint64_t mask = dw1000_get(chip, SYS_MASK, 0, 4) & UINT64_C(0x3FFFFFFE);
    return chip->status & mask ? chip->status | ST_IRQS : chip->status;
}

void dw1000_update_line(dw1000_chip *chip) {
    const bool asserted = (dw1000_status(chip) & ST_IRQS) != 0;
    const bool active_high = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_HIRQ_POL) != 0;
    const bool line = asserted == active_high;
    if (line && !chip->line) {
        wake_waiter(chip);
    }
    chip->line = line;
}

void dw1000_raise_status(dw1000_chip *chip, uint64_t bits) {
    chip->status |= bits;
    dw1000_update_line(chip);
}

void dw1000_clear_status(dw1000_chip *chip, uint64_t bits) {
    chip->status &= ~bits;
    dw1000_update_line(chip);
}
